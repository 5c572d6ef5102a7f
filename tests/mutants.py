"""Damaged copies of a file's content, each made by a seed: bytes, JSON trees and arrays."""

from __future__ import annotations

import io
import json
import re
import zipfile
from copy import deepcopy
from typing import Any

import numpy as np

_NUMBERS = b"0 -1 1e999 NaN 99999999999999999999 0x10 1_0 \x00 - . e".split(b" ")
_VALUES: list[Any] = [
    None, True, -1, 0, 10**400, 1e308, 1e-320, float("nan"), float("inf"), "", "\x00", "../../evil", "/abs", "x" * 5000,
    "\ud800", [], {}, [[]], [None], {"": None}, [1, 2, 3], [0.0] * 10_000, {"a": {"b": [{}]}},
]  # fmt: skip


def damaged_bytes(content: bytes, seed: int) -> bytes:
    """Some bytes flipped, cut out, repeated, or replaced by odd numbers."""
    rng = np.random.default_rng(seed)
    data = bytearray(content)
    for _ in range(rng.integers(1, 6)):
        at, length = int(rng.integers(0, len(data) + 1)), int(rng.integers(1, 40))
        what = rng.integers(0, 5)
        if what == 0 and at < len(data):
            data[at] ^= int(rng.integers(1, 256))
        elif what == 1:
            del data[at : at + length]
        elif what == 2:
            data[at:at] = data[at : at + length]
        elif what == 3:
            data[at : at + int(rng.integers(0, 4))] = _NUMBERS[rng.integers(0, len(_NUMBERS))]
        else:
            del data[at if rng.random() < 0.2 else len(data) - length :]
        data = data or bytearray(b"x")
    return bytes(data)


def damaged_json(content: bytes, seed: int) -> bytes:
    """One to three nodes of a JSON tree replaced, removed, repeated or nested; now and then its bytes damaged."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.2:
        return damaged_bytes(content, seed)
    if rng.random() < 0.03:
        return b"[" * 100_000
    tree = [json.loads(content)]
    for _ in range(rng.integers(1, 4)):
        parent, key = _somewhere(tree, rng)
        what = rng.integers(0, 10)
        if what == 0 and parent is not tree:
            del parent[key]
        elif what == 1 and isinstance(parent, list):
            parent.append(deepcopy(parent[key]))
        elif what == 2:
            parent[key] = [parent[key]]
        elif what == 3 and isinstance(parent, dict):
            parent["surprise"] = 1
        elif what == 4 and isinstance(parent[key], float):
            parent[key] = parent[key] * float(10.0 ** rng.integers(-300, 300))
        else:
            parent[key] = deepcopy(_VALUES[rng.integers(0, len(_VALUES))])
    return json.dumps(tree[0]).encode()


def _somewhere(tree: list[Any], rng: np.random.Generator) -> tuple[Any, Any]:
    """A random node, as its parent and its key there."""
    parent, key = tree, 0
    while isinstance(parent[key], list | dict) and parent[key] and rng.random() < 0.85:
        parent = parent[key]
        keys = list(parent) if isinstance(parent, dict) else range(len(parent))
        key = keys[int(rng.integers(0, len(keys)))]
    return parent, key


def damaged_arrays(content: bytes, seed: int) -> bytes:
    """An ``.npz`` file with an array of another shape, type or content, a damaged header, or damaged bytes."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.25:
        return damaged_bytes(content, seed)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[rng.integers(0, len(members))]
    array = np.load(io.BytesIO(members[name]))
    what = rng.integers(0, 8)
    if what == 0:
        del members[name]
    elif what == 1:
        start = bytes(members[name][:128])
        members[name] = damaged_bytes(start, seed) + members[name][128:]
    elif name.startswith("report"):
        members[name] = _npy(np.array(damaged_json(str(array).encode(), seed).decode(errors="replace")))
    else:
        flat = array.reshape(-1)
        changed: list[Any] = [
            array[: len(array) // 2], array.astype(np.float64) * np.nan, array.astype("U8"), np.zeros((0, 7)), flat,
            array.astype(np.complex128), np.array(5), np.where(np.arange(flat.size) == 0, 10**9, flat), array[None],
        ]  # fmt: skip
        members[name] = _npy(changed[rng.integers(0, len(changed))])
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return buffer.getvalue()


def _npy(array: Any) -> bytes:
    np.save(buffer := io.BytesIO(), array)
    return buffer.getvalue()


def damaged_numbers(content: bytes, seed: int) -> bytes:
    """One to three numbers of the first kilobytes changed: those that are written out, or 1 to 8 bytes as integers."""
    rng = np.random.default_rng(seed)
    data = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        written = list(re.finditer(rb"\b\d+\b|\b[a-zA-Z_]\w*\b", data[:4000]))
        if written and rng.random() < 0.6:
            found = written[rng.integers(0, len(written))]
            value = _NUMBERS[rng.integers(0, len(_NUMBERS))]
            if found[0].isdigit() and rng.random() < 0.7:
                value = str(int(found[0][:18]) * 10 ** int(rng.integers(0, 6)) + int(rng.integers(-1, 2))).encode()
            elif not found[0].isdigit() and rng.random() < 0.7:
                value = bytes([rng.integers(65, 91)]) + found[0][1:]
            data[found.start() : found.end()] = value
        else:
            size = int(2 ** rng.integers(0, 4))
            at = int(rng.integers(0, max(1, min(len(data), 600) - size)))
            value = int(rng.choice([0, 1, 2, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 10**6, 2**40, 2**63]))
            data[at : at + size] = (value % 256**size).to_bytes(size, "little")
    return bytes(data)
