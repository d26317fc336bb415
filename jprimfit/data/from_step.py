"""Parts of a data set from the solids of a STEP file: exact surfaces, exact areas, a triangulation to draw points from.

What touches and lies on one surface is one instance, as in instances.py: the two half cylinders that CAD programs make
of a hole are merged. Faces under min_share of the area and those on other surfaces are BACKGROUND.
"""

from typing import NamedTuple

import numpy as np

from jprimfit.cad import step_reader
from jprimfit.data import instances
from jprimfit.data.records import Part
from jprimfit.data.solids import Body


class Found(NamedTuple):
    """The parts of a file, and sentences on what of it is no part."""

    parts: tuple[Part, ...]
    notes: tuple[str, ...]


def parts(contents: step_reader.Contents, *, source: str, min_share: float, name: str, **fields) -> Found:
    """The part `name` of a file with one solid, name_1, name_2, ... of several; further fields go to every Part.

    Parts are in the normalised frame; center and scale lead back to the frame and unit of the file. ValueError of one
    sentence, which begins with source, where none of its solids has an instance.
    """
    found, empty = [], []
    for number, body in enumerate(contents.bodies, start=1):
        part = instances.part_of_body(
            Body(body.vertices, body.triangles, body.face_index, body.surfaces),
            min_share=min_share,
            name=name if len(contents.bodies) == 1 else f"{name}_{number}",
            known_areas=body.areas,
            unit=contents.unit,
            **fields,
        )
        if part is None:
            empty.append(number)
        else:
            size = contents.millimetres
            found.append(part._replace(center=np.asarray(part.center) / size, scale=part.scale / size))
    words = f"no plane, sphere, cylinder or cone has {100 * min_share:g} % of the area"
    if not found:
        raise ValueError(f"{source} cannot be used: {words} of its solid.")
    notes = [f"{source}: solid {number} is left out because {words}." for number in empty]
    if contents.num_loose:
        notes.append(f"{source}: {contents.num_loose} faces that belong to no solid are left out.")
    if contents.num_open:
        count = f"{contents.num_open} of {len(contents.bodies)} bodies"
        notes.append(f"{source}: not closed ({count}): faces are missing or do not meet.")
    return Found(tuple(found), tuple(notes))
