"""Agents that harvest.

Oracles rehearse picks in copies of the simulation: `harvester`, in the order that `picking_order` finds, and
`truss_cutter`, by `rehearsal` and, along a row, `rail`. `scan_harvester` knows a scan and the camera at its wrist:
`sensed_hand` turns observations into what the arm senses, `fruit_map` follows fruit (`scanned_trusses`, `truss_pose`,
`sphere_search`), `seen_surface` keeps what else the camera sees, `scanned_stand` joins them into a scene,
`scanned_paths` plans in it, and `imagined_pick` chooses how to take a fruit off. All of them move by `picking`.
"""
