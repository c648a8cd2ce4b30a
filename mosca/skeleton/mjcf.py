"""Models of skeletons as MJCF text: check of the elements in it, before MuJoCo compiles it.

A model may come from anybody. So it must be one text, with elements that place bodies, joints and sites. Elements
that name another file (include, assets, plugins) or multiply themselves (replicate, composite) are refused.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from xml.etree.ElementTree import Element

import mujoco
import numpy as np

from mosca.errors import InputError

MOST_BYTES = 1 << 20
"""Largest size of a model's text [B]: that of a person has 16 kB."""
MOST_DEPTH, MOST_BODIES, MOST_SITES = 64, 200, 500
"""Most nested elements, bodies and sites: fitting takes matrices of three times bodies and sites squared."""
FARTHEST_M = 100.0
"""No joint and no marker is farther than this from its body's origin [m]: the unit would be wrong."""
NEAREST_M, LEAST_DEG = 1e-6, 1e-3
"""Least distances and standard deviations [m], if not 0, and least standard deviations of rotations [deg]: their
squares are divisors."""
ELEMENTS = frozenset((
    "mujoco", "compiler", "option", "flag", "size", "visual", "global", "quality",
    "headlight", "map", "scale", "rgba", "statistic", "default", "custom", "numeric",
    "text", "tuple", "element", "worldbody", "body", "joint", "freejoint", "site",
    "geom", "inertial", "camera", "light",
))  # fmt: skip
"""Elements that a model may have. Any other may read a file, or create any number of others."""
SIGMA, MIDPOINT = "rotation_sigma_deg/", "midpoint/"
_WRONG = "{source}: not a skeleton model: {reason}; docs/people.md says what a model holds"


class _PlainTree(ElementTree.TreeBuilder):
    """Builder of elements and comments, of limited depth, without a document type: entities could be any text."""

    def __init__(self) -> None:
        super().__init__(insert_comments=True)
        self._depth = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse a document type."""
        raise ValueError(f"<!DOCTYPE {name[:40]}> stands in it")

    def start(self, tag: str, attributes: dict[str, str]) -> Element:
        """Begin an element."""
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise ValueError(f"elements stand more than {MOST_DEPTH} deep inside each other")
        return super().start(tag, attributes)

    def end(self, tag: str) -> Element:
        """End an element."""
        self._depth -= 1
        return super().end(tag)


def mjcf_tree(text: str, source: str) -> Element:
    """Return the elements of an MJCF text; InputError, naming ``source``, where one is not allowed."""
    try:
        if len(text) > MOST_BYTES:
            raise ValueError(f"it has {len(text)} characters, {MOST_BYTES} are read at most")
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=_PlainTree()))
        for element in root.iter():
            _check_element(element)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(_WRONG.format(source=source, reason=str(error).splitlines()[0])) from None
    return root


def _check_element(element: Element) -> None:
    if not isinstance(element.tag, str):  # a comment
        return
    if element.tag not in ELEMENTS:
        raise ValueError(f"<{element.tag[:40]}> stands in it; other files and repeated bodies are not read")
    if named := [name for name in element.attrib if "file" in name]:
        raise ValueError(f"<{element.tag} {named[0][:40]}=...> names a file; other files are not read")
    if element.tag == "size" and dict(element.attrib) not in ({}, {"nuser_site": "3"}):
        raise ValueError('<size nuser_site="3"/> is the one size that a model states')
    if element.tag == "numeric" and "size" in element.attrib:
        raise ValueError("<numeric size=...> stands in it; its data say how many there are")


def compiled(text: str, source: str) -> mujoco.MjModel:
    """Return the model that an MJCF text holds, compiled by MuJoCo.

    InputError, naming ``source``, where it is no skeleton. A skeleton has a root body with a free joint; all other
    bodies are below it, with one ball joint at their origin; all joints and sites have names.
    """
    mjcf_tree(text, source)
    try:
        with _warnings_raised():
            mj = mujoco.MjModel.from_xml_string(text)
        _check_structure(mj)
        _check_knowledge(mj)
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(_WRONG.format(source=source, reason=" ".join(str(error).split())[:200])) from None
    return mj


@contextmanager
def _warnings_raised() -> Iterator[None]:
    """Raise ValueError for the first warning of MuJoCo, which otherwise goes to a file in the working folder."""
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
    if told:
        raise ValueError(told[0])


def _check_structure(mj: mujoco.MjModel) -> None:
    """Raise ValueError where bodies, joints and sites are not those of a skeleton."""
    if mj.nbody > MOST_BODIES or mj.nsite > MOST_SITES:
        raise ValueError(f"{mj.nbody} bodies, {mj.nsite} sites; at most {MOST_BODIES}, {MOST_SITES} are read")
    if mj.njnt < 2 or not np.array_equal(mj.jnt_bodyid, np.arange(1, mj.nbody)):
        raise ValueError(
            f"{mj.nbody - 1} bodies with {mj.njnt} joints; two or more bodies with one joint each are wanted"
        )
    free, ball = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
    if mj.jnt_type[0] != free or (mj.jnt_type[1:] != ball).any() or (mj.body_parentid[2:] == 0).any():
        raise ValueError("a free joint for the root and ball joints for all bodies below it are wanted")
    if (mj.jnt_pos != 0).any():
        raise ValueError(f"joint '{mj.joint(int(np.nonzero(mj.jnt_pos)[0][0])).name}' is off its body's origin (pos)")
    for kind, names in (
        ("body", [mj.body(k).name for k in range(1, mj.nbody)]),
        ("joint", [mj.joint(k).name for k in range(mj.njnt)]),
        ("site", [mj.site(k).name for k in range(mj.nsite)]),
    ):
        if "" in names:
            raise ValueError(f"{kind} {names.index('')} has no name; all bodies, joints and sites have one")
    far = np.abs(np.concatenate([mj.body_pos, mj.site_pos])).max(axis=1)
    if not (far <= FARTHEST_M).all() or ((far > 0) & (far < NEAREST_M)).any():
        raise ValueError(
            f"a body or site is not 0 or {NEAREST_M:g} to {FARTHEST_M:g} m from its parent; lengths are in m"
        )


def _check_knowledge(mj: mujoco.MjModel) -> None:
    """Raise ValueError where a custom element whose name has a meaning here has invalid contents."""
    joints = [mj.joint(k).name for k in range(1, mj.njnt)]
    if mj.nuser_site not in (0, 3) or ((mj.site_user > 0) & (mj.site_user < NEAREST_M)).any():
        raise ValueError(f"user of a site: standard deviations along x, y, z of {NEAREST_M:g} or more are wanted [m]")
    for k in range(mj.nnumeric):
        name, first, n = mj.numeric(k).name, int(mj.numeric_adr[k]), int(mj.numeric_size[k])
        if not name.startswith(SIGMA):
            continue
        values = mj.numeric_data[first : first + n]
        if n != 3 or not ((values >= LEAST_DEG) & (values < np.inf)).all():
            raise ValueError(f"numeric '{name}': three numbers of {LEAST_DEG:g} or more are wanted [deg]")
        if name.removeprefix(SIGMA) not in joints:
            raise ValueError(f"numeric '{name}' names no ball joint")
    for k in range(mj.ntuple):
        name, first, n = mj.tuple(k).name, int(mj.tuple_adr[k]), int(mj.tuple_size[k])
        if not name.startswith(MIDPOINT):
            continue
        if n != 2 or (mj.tuple_objtype[first : first + n] != mujoco.mjtObj.mjOBJ_SITE).any():
            raise ValueError(f"tuple '{name}': two sites are wanted")
        if (joint := name.removeprefix(MIDPOINT)) not in joints:
            raise ValueError(f"tuple '{name}' names no ball joint")
        pair = mj.tuple_objid[first : first + n]
        if (mj.site_bodyid[pair] != mj.body_parentid[joints.index(joint) + 2]).any():
            raise ValueError(f"tuple '{name}': its sites are not of the body above the joint")
        if np.linalg.norm(np.diff(mj.site_pos[pair], axis=0)) < NEAREST_M:
            raise ValueError(f"tuple '{name}': its sites are at one place")
