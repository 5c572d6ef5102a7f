"""Ripe fruit as a scan shows them, followed by what a color camera at the wrist sees of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from greenhouse_gym.agents.harvest.scanned_trusses import scanned_trusses
from greenhouse_gym.agents.harvest.sphere_search import fitted_center, spheres_on
from greenhouse_gym.agents.harvest.truss_pose import MIN_PIXELS, SkinImage, Truss, fitted, skin_of
from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.scene.obstacles import Surroundings
from greenhouse_gym.scene.plants.mechanics import GRAVITY, PlantMechanics

_RED, _FAR = 1.5, 0.7  # red over green and blue on ripe skin, and largest depth of such a pixel, metres
_RIPE = 0.5  # ripeness in the scan from which skin is red
_OWN = 0.012  # metres from the skin of a held fruit within which pixels are its own
_SEEN, _WINDOW = 0.06, 0.14  # metres from fruit to skin of those that the scan lacks, and to what is compared
_IN_VIEW = 0.5  # fraction of the fruit of a truss by which it is followed
_UNKNOWN = 0.008  # metres from known fruit to skin of one that the scan lacks
_SETTLES, _FORGOTTEN = 0.3, 10  # weight of an image for where a truss rests, and images without it until it does
_SEARCH = 3  # images from one search of a truss to the next
_SWAY, _AWAY, _FADES = 0.015, 0.02, 0.9  # metres: skin of a fruit, and from where its truss has it; see _sway
_MIN_DISC, _THROUGH, _SHOWN = 6, 0.6, 0.25  # pixels of a disc, and fractions of them: see _check_presence
_GONE = 6  # images that look through a fruit until it counts as gone
_HEAVINESS = GRAVITY * PlantMechanics().density * 4 / 3 * np.pi  # N per cubed radius, m
_RADII = 0.75, 1.35  # radius of a fruit by its weight over that of the scan
_PEDICEL, _NEXT_TO = 0.012, 0.05  # metres from a fruit to its rachis without a stem, and within which stems count


class FruitMap:
    """Ripe fruit with their current positions; points are in the scene, metres.

    A truss rises as fruit come off it, by centimetres. Its fruit therefore are followed together: the truss turns about
    its root, and each fruit sways a little.

    Args:
        scene: The scene as it was scanned.

    Attributes:
        centers: (n, 3) middles of the scene's tomatoes, and of fruit that the scan lacks.
        radii: (n,) their radii.
        turns: (trusses, 3, 3) rotations of the trusses about their roots since the scan.
        trusses: The trusses as scanned.
        of: (n,) truss of each fruit.
    """

    def __init__(self, scene: Surroundings):
        self._scanned = np.array([tomato.center for tomato in scene.tomatoes]).reshape(-1, 3)
        self.centers = self._scanned.copy()
        self.radii = np.array([tomato.radius for tomato in scene.tomatoes])
        self._ripe = np.array([tomato.ripeness is None or tomato.ripeness >= _RIPE for tomato in scene.tomatoes])
        self.trusses = scanned_trusses(scene)
        self.of = self.trusses.of
        self.turns = np.tile(np.eye(3), (len(self.trusses.roots), 1, 1))
        self._rests = self.turns.copy()
        self._since_seen = np.zeros(len(self.turns), dtype=np.int64)
        self._sways = np.zeros_like(self.centers)
        self._picked = np.zeros(len(self.radii), dtype=np.bool_)
        self._risen: dict[int, Array] = {}
        self._through = np.zeros(len(self.radii), dtype=np.int64)
        self._images, self._pulled = 0, -1
        self._searched = np.full(len(self.turns), -_SEARCH)
        self._joints = self._scanned + np.array([0.0, 0.0, 1.0]) * (self.radii + _PEDICEL)[:, None]
        ends = [at for stem in scene.stems if stem.kind == "peduncle" for at in (stem.start, stem.end)]
        if ends and len(self._joints):
            apart = cdist(self._joints, ends)
            close = apart.min(axis=1) < _NEXT_TO
            self._joints[close] = np.array(ends)[apart.argmin(axis=1)[close]]

    @property
    def hanging(self) -> npt.NDArray[np.bool_]:
        """(n,) whether fruit still hang, as far as it is known."""
        return np.asarray(~self._picked & (self._through < _GONE))

    @property
    def weights(self) -> Array:
        """(n,) weights of the fruit by their radii, N."""
        return np.asarray(_HEAVINESS * self.radii**3)

    def weigh(self, fruit: int, weight: float) -> None:
        """Take over the weight of a fruit, N, and the radius by it, which the scan knows to a tenth."""
        radius = float(np.cbrt(max(weight, 0.0) / _HEAVINESS))
        self.radii[fruit] *= np.clip(radius / self.radii[fruit], *_RADII)

    def pick(self, fruit: int) -> None:
        """Count a fruit as picked; its truss rises by what its spring is relieved of."""
        if not self._picked[fruit]:
            self._picked[fruit] = True
            self.relieve(fruit)

    def rise(self, fruit: int) -> Array:
        """Return the rotation (3,), radians, by which a truss rises without the weight of a fruit.

        The spring at its root is that of the default mechanics, see `PlantMechanics.max_sag`.
        """
        truss, mechanics = int(self.of[fruit]), PlantMechanics()
        root, mine = self.trusses.roots[truss], self.of == truss
        weights = self.weights
        load = (weights[mine, None] * (self._scanned[mine] - root)[:, :2]).sum(axis=0)
        stiffness = max(mechanics.truss_stiffness, float(np.linalg.norm(load)) / mechanics.max_sag)
        return np.asarray(weights[fruit] * np.cross((self.centers[fruit] - root), [0.0, 0.0, 1.0]) / stiffness)

    def jump(self, fruit: int) -> float:
        """Return the distance by which the place of a fruit on its truss rises without its weight, metres."""
        lever = self.centers[fruit] - self.trusses.roots[self.of[fruit]]
        return float(np.linalg.norm(self.rise(fruit)) * np.linalg.norm(lever[:2]))

    def relieve(self, fruit: int) -> None:
        """Let a truss rise, once, as without the weight of a fruit."""
        if fruit not in self._risen:
            self._risen[fruit] = self.rise(fruit)
            self._turn(int(self.of[fruit]), self._risen[fruit])

    def hang(self, fruit: int) -> None:
        """Count a fruit that was taken for picked as hanging; its truss bears its weight again."""
        self._picked[fruit] = False
        self._turn(int(self.of[fruit]), -self._risen.pop(fruit, np.zeros(3)))

    def _turn(self, truss: int, turn: Array) -> None:
        """Turn a truss about its root by a rotation (3,), radians."""
        if turn.any():
            for turns in (self.turns, self._rests):
                turns[truss] = rotation_about(turn, float(np.linalg.norm(turn))) @ turns[truss]
            self._place(truss)

    def _place(self, truss: int) -> None:
        mine, root = self.of == truss, self.trusses.roots[truss]
        self.centers[mine] = root + (self._scanned[mine] - root) @ self.turns[truss].T + self._sways[mine]

    def joint(self, fruit: int) -> Array:
        """Return the presumed start (3,) of a fruit's pedicel."""
        truss = int(self.of[fruit])
        root = self.trusses.roots[truss]
        return np.asarray(root + self.turns[truss] @ (self._joints[fruit] - root))

    def see(
        self, rays: Array, origin: Array, depth: Array, color: npt.NDArray[np.uint8], held: tuple[int, Array] | None
    ) -> None:
        """Follow the fruit that an image shows.

        Args:
            rays: (m, 3) offsets from the camera through the pixels, of depth 1.
            origin: (3,) position of the camera.
            depth: (m,) depths at the pixels; 0 without a reading.
            color: (m, 3) their colors.
            held: Number and middle of the fruit in the cup, or None.
        """
        self._images += 1
        red, green, blue = color.astype(np.float64).T
        skin = (depth > 0) & (depth < _FAR) & (red > _RED * green) & (red > _RED * blue)
        if held is not None:
            outside = np.linalg.norm(origin + depth[:, None] * rays - held[1], axis=1) - self.radii[held[0]]
            skin &= np.abs(outside) > _OWN
        self._pulled = -1 if held is None or self._picked[held[0]] else int(self.of[held[0]])
        lengths = np.linalg.norm(rays, axis=1)
        image = SkinImage(origin, rays / lengths[:, None], np.where(depth > 0, depth * lengths, np.inf), skin)
        follows = ~self._picked & self._ripe
        if held is not None:
            follows[held[0]] = False
        left = np.flatnonzero(follows)
        self._since_seen += 1
        if np.count_nonzero(skin) >= MIN_PIXELS and len(left):
            near = np.linalg.norm(self.centers[left] - origin, axis=1) < _FAR
            for truss in np.unique(self.of[left[near & image.shows(self.centers[left])]]).tolist():
                self._follow(truss, left, image)
        for truss in np.flatnonzero(self._since_seen == _FORGOTTEN).tolist():  # it swings until it rests
            self.turns[truss] = self._rests[truss]
            self._place(truss)

    def _follow(self, truss: int, left: npt.NDArray[np.int64], image: SkinImage) -> None:
        """Fit a truss to an image."""
        own, others = left[self.of[left] == truss], left[self.of[left] != truss]
        middle = self.centers[own].mean(axis=0)
        around = float((np.linalg.norm(self.centers[own] - middle, axis=1) + self.radii[own]).max()) + _WINDOW
        image = image.around(middle, around)
        present = own[self.hanging[own]] if self.hanging[own].any() else own
        points, checks = image.points, False
        if len(points) >= MIN_PIXELS and len(present) and image.shows(self.centers[present]).mean() > _IN_VIEW:
            root = self.trusses.roots[truss]
            taken = _distances(points, self.centers[others], self.radii[others])
            search = self._images - self._searched[truss] >= _SEARCH
            scanned = Truss(root, self._scanned[present], self.radii[present])
            before = self.turns[truss]
            self.turns[truss], reliable = fitted(image, scanned, before, taken, search)
            self._since_seen[truss], checks = 0, reliable or search
            if truss != self._pulled:
                self._rests[truss] = _between(self._rests[truss], self.turns[truss], _SETTLES)
            if search:
                self._searched[truss] = self._images
            self._sway(present, scanned.turned(self.turns[truss]), points, taken)
            if reliable:
                self._discover(truss, image, taken)
        self._place(truss)
        if checks:
            self._check_presence(own, image)

    def _check_presence(self, fruit: npt.NDArray[np.int64], image: SkinImage) -> None:
        """Count the images that look through fruit (n,), which at last count as gone; their truss rises."""
        discs, shown, through = image.seen(self.centers[fruit], self.radii[fruit])
        empty = (discs >= _MIN_DISC) & (through > _THROUGH * discs)
        self._through[fruit[(discs >= _MIN_DISC) & (shown > _SHOWN * discs)]] = 0
        self._through[fruit[empty]] += 1
        for gone in fruit[empty & (self._through[fruit] == _GONE)].tolist():
            self.relieve(gone)

    def _discover(self, truss: int, image: SkinImage, taken: Array) -> None:
        """Add fruit of a truss that the scan lacks, which would be mistaken for its neighbors."""
        mine = np.flatnonzero(self.of == truss)
        root, turn, points = self.trusses.roots[truss], self.turns[truss], image.points
        centers = root + (self._scanned[mine] - root) @ turn.T + self._sways[mine]
        outside = (cdist(points, centers) - self.radii[mine]).min(axis=1)
        points = points[(outside > _UNKNOWN) & (outside < _SEEN) & (np.abs(taken) > _UNKNOWN)]
        radius = float(np.median(self.radii[mine]))
        for center in spheres_on(points, image.origin, radius, centers):
            scanned = root + (center - root) @ turn
            self._scanned, self.centers = np.vstack([self._scanned, scanned]), np.vstack([self.centers, center])
            self._joints = np.vstack([self._joints, scanned + [0.0, 0.0, radius + _PEDICEL]])
            self._sways = np.vstack([self._sways, np.zeros(3)])
            self.radii, self.of = np.append(self.radii, radius), np.append(self.of, truss)
            self._ripe, self._picked = np.append(self._ripe, True), np.append(self._picked, False)
            self._through = np.append(self._through, 0)

    def _sway(self, fruit: npt.NDArray[np.int64], turned: Array, points: Array, taken: Array) -> None:
        """Find how far fruit (n,) are from where their truss has them (n, 3)."""
        rows, owner, _ = skin_of(points, turned + self._sways[fruit], self.radii[fruit], taken, _SWAY)
        for k, one in enumerate(fruit.tolist()):
            skin = points[rows[owner == k]]
            if len(skin) < MIN_PIXELS:
                self._sways[one] *= _FADES
                continue
            offset = fitted_center(skin, turned[k] + self._sways[one], float(self.radii[one])) - turned[k]
            self._sways[one] = offset * min(1.0, _AWAY / max(float(np.linalg.norm(offset)), 1e-9))


def _between(first: Array, second: Array, fraction: float) -> Array:
    """Return the rotation (3, 3) at a fraction of the way from one to another."""
    step = Rotation.from_matrix(second @ first.T).as_rotvec()
    return np.asarray(Rotation.from_rotvec(fraction * step).as_matrix() @ first)


def _distances(points: Array, centers: Array, radii: Array) -> Array:
    """Return distances (k,) of points (k, 3) from the nearest fruit, infinite without fruit."""
    if not len(centers):
        return np.full(len(points), np.inf)
    outside = cdist(points, centers) - radii
    return np.asarray(outside[np.arange(len(points)), np.abs(outside).argmin(axis=1)])
