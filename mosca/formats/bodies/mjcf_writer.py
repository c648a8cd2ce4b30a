"""A fitted model as MJCF: the model's text in which fitted positions replace those of its joints and markers."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from mosca.data.arrays import Array
from mosca.data.files.whole_file import write_text
from mosca.skeleton.fit import FittedSubject
from mosca.skeleton.mjcf import mjcf_tree


def write_mjcf(subject: FittedSubject, path: Path) -> None:
    """Write the model of ``subject`` to ``path``, every number at full precision, whole or not at all.

    Markers that were not in the take keep their position, scaled by the subject's size.
    """
    model = subject.model
    root = mjcf_tree(model.mjcf, str(path))
    world = root.find("worldbody")
    assert world is not None
    # MuJoCo numbers bodies, and thus joints, in the order of the text
    for joint, body in zip(model.joints, list(world.iter("body"))[1:], strict=True):
        body.set("pos", _text(subject.parameters[model.joint_rows(joint)]))
    for site in world.iter("site"):
        name = site.get("name", "")
        if name in model.labels:
            site.set("pos", _text(subject.parameters[model.marker_rows(name)]))
        elif "pos" in site.attrib:
            site.set("pos", " ".join(repr(subject.size * float(x)) for x in site.get("pos", "").split()))
    write_text(path, ElementTree.tostring(root, encoding="unicode") + "\n")


def _text(place: Array) -> str:
    return " ".join(map(repr, place.tolist()))
