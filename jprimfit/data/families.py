"""The families of parts by name, and the split each belongs to.

Near copies of a part must stay on one side, so whole families are kept for validation and for the test set. A family
maps a random generator to a solid about 2 units long.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType, ModuleType

import numpy as np

from jprimfit.data import families_held_out, families_prismatic, families_random, families_turned
from jprimfit.data.solids import Solid

Family = Callable[[np.random.Generator], Solid]

TRAIN = (
    *("random_solid", "aligned_solid", "random_profile"),
    *("stepped_shaft", "collar", "flange", "pulley", "bushing", "nozzle", "ball_stud", "dome_cap", "round_pin"),
    *("bracket", "drilled_plate", "hex_nut", "stepped_block", "lever", "hinge", "rounded_prism", "hub_plate"),
    "dimpled_plate",
)
VALIDATION = ("clevis", "pillow_block", "slotted_profile", "taper_plug")
TEST = (
    *("hex_bolt", "socket_screw", "tee_fitting", "knob", "stud_plate", "v_block", "valve_body", "cross_yoke"),
    *("mitre_elbow", "crank", "slotted_screw"),
)


def _named() -> Mapping[str, Family]:
    rooms: tuple[ModuleType, ...] = (families_random, families_turned, families_prismatic, families_held_out)
    found = {}
    for name in (*TRAIN, *VALIDATION, *TEST):
        found[name] = next(getattr(room, name) for room in rooms if hasattr(room, name))
    return MappingProxyType(found)


FAMILIES = _named()
