"""The families of parts by name, and the split each belongs to.

Near copies of a part must stay on one side, so whole families are kept for validation and for the test set. A family
maps a random generator to a solid about 2 units long; a family of standard parts to one with its unit in millimetres
(standard_blanks.Measured). The two sets of families are made to be mixed: what resembles a test family of one of them
(bolts, screws and studs with heads, tees, valves) is a test family of the other, and so for validation (blocks, plugs).
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType, ModuleType

import numpy as np

from jprimfit.data import (
    families_held_out,
    families_prismatic,
    families_random,
    families_turned,
    standard_bearings,
    standard_bolts,
    standard_fittings,
    standard_flanges,
    standard_machine,
    standard_nuts_washers,
    standard_pins,
    standard_profiles,
    standard_screws,
)
from jprimfit.data.solids import Solid
from jprimfit.data.standard_blanks import Measured

Family = Callable[[np.random.Generator], Solid | Measured]

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
STANDARD_TRAIN = (
    *("hexagon_nut", "jam_nut", "square_nut", "coupling_nut", "slotted_nut", "cap_nut", "flange_nut"),
    *("plain_washer", "chamfered_washer", "spherical_washer"),
    *("dowel_pin", "taper_pin", "grooved_pin", "spring_pin", "clevis_pin", "parallel_key"),
    *("cup_set_screw", "cone_set_screw", "oval_set_screw", "flat_set_screw", "dog_set_screw"),
    *("blind_flange", "slip_on_flange", "weld_neck_flange", "lapped_flange", "full_face_gasket", "ring_gasket"),
    *("steel_pipe", "pipe_nipple", "hexagon_nipple", "pipe_reducer", "pipe_cap", "pipe_coupling", "reducing_coupling"),
    *("pipe_bushing", "pipe_union", "spacer_ring", "shaft_collar", "retaining_ring", "keyed_shaft"),
    *("angle_profile", "channel_profile", "wide_flange_profile", "bearing_pile_profile", "tee_profile"),
    "gusset_bracket",
)
STANDARD_VALIDATION = ("pipe_plug", "bearing_block", "ball_bearing", "roller_bearing", "tapered_roller_bearing")
STANDARD_TEST = (
    *("hexagon_bolt", "heavy_hexagon_bolt", "hexagon_cap_screw", "flange_bolt", "carriage_bolt"),
    *("socket_cap_screw", "button_head_screw", "socket_flat_screw", "shoulder_screw"),
    *("flat_head_screw", "oval_head_screw", "pan_head_screw", "round_head_screw", "truss_head_screw"),
    *("fillister_head_screw", "drive_stud", "pipe_tee", "reducing_tee", "valve_housing", "roller_sprocket"),
)


def _named() -> Mapping[str, Family]:
    rooms: tuple[ModuleType, ...] = (
        *(families_random, families_turned, families_prismatic, families_held_out, standard_bearings, standard_bolts),
        *(standard_fittings, standard_flanges, standard_machine, standard_nuts_washers, standard_pins),
        *(standard_profiles, standard_screws),
    )
    found = {}
    for name in (*TRAIN, *VALIDATION, *TEST, *STANDARD_TRAIN, *STANDARD_VALIDATION, *STANDARD_TEST):
        found[name] = next(getattr(room, name) for room in rooms if hasattr(room, name))
    return MappingProxyType(found)


FAMILIES = _named()
