"""The GenICam XML file, which describes the feature tree and the registers behind it (GenApi schema 1.1)."""

import xml.etree.ElementTree as Xml
from collections.abc import Iterable, Mapping

from hardware.emulate.features import Feature
from hardware.emulate.registers import Register

NAMESPACE = "http://www.genicam.org/GenApi/Version_1_1"
SCHEMA = "http://www.genicam.org/GenApi/GenApiSchema_Version_1_1.xsd"
DESCRIPTION = {
    "StandardNameSpace": "GEV",
    "SchemaMajorVersion": "1",
    "SchemaMinorVersion": "1",
    "SchemaSubMinorVersion": "0",
    "MajorVersion": "1",
    "MinorVersion": "0",
    "SubMinorVersion": "0",
    "ToolTip": "A source of frames as a camera",
    "ProductGuid": "7C1E4B52-3D0A-4E7B-9C55-2B8D5C7A9E10",
    "VersionGuid": "B4F2A6D0-8E31-4C9F-A1D7-60F3E8B2C945",
    "xmlns": NAMESPACE,
    "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
    "xsi:schemaLocation": f"{NAMESPACE} {SCHEMA}",
}
ELEMENTS = {
    "integer": "Integer",
    "float": "Float",
    "enumeration": "Enumeration",
    "boolean": "Boolean",
    "command": "Command",
}
LOCK = "TLParamsLocked"


def describe(tree: Iterable[Feature], registers: Mapping[str, Register], vendor: str, model: str) -> bytes:
    """Return the XML file of a camera with the features ``tree`` over ``registers`` (by name)."""
    root = Xml.Element("RegisterDescription", {"ModelName": model, "VendorName": vendor, **DESCRIPTION})
    tree = tuple(tree)
    categories: dict[str, list[str]] = {}
    for feature in tree:
        if feature.category is not None:
            categories.setdefault(feature.category, []).append(feature.name)
    categories["TransportLayerControl"].append(LOCK)
    _category(root, "Root", categories)
    for name, members in categories.items():
        _category(root, name, members)
    for feature in tree:
        if feature.chunk:
            _feature(root, feature, Register(feature.name, 0, feature.length, "RO"))
            _say(_node(root, "Port", _port(feature)), ChunkID=f"{feature.chunk:08X}")
        else:
            _feature(root, feature, registers[feature.register or feature.name])
    lock = _node(root, "Integer", LOCK)
    _say(lock, Visibility="Invisible", Value=0, Min=0, Max=1)
    _node(root, "Port", "Device")
    Xml.indent(root)
    return _unmistakable(bytes(Xml.tostring(root, encoding="utf-8", xml_declaration=True)))


def _unmistakable(xml: bytes) -> bytes:
    """Return ``xml``, lengthened until its length has a letter in hexadecimal.

    A client finds the file by an address and a length in bare hexadecimal digits; some take those without a letter
    for decimal ones (pyGigEVision 0.2.2).
    """
    while f"{len(xml):x}".isdecimal():
        xml += b"\n"
    return xml


def _category(root: Xml.Element, name: str, members: Iterable[str]) -> None:
    category = _node(root, "Category", name)
    for member in members:
        _say(category, pFeature=member)


def _feature(root: Xml.Element, feature: Feature, register: Register) -> None:
    if feature.kind == "string":
        node = _node(root, "StringReg", feature.name)
        _at(node, register, feature)
        return
    behind = f"{feature.name}Reg"
    node = _node(root, ELEMENTS[feature.kind], feature.name)
    if feature.tip:
        _say(node, ToolTip=feature.tip)
    _say(node, Visibility="Beginner" if feature.category is not None else "Invisible")
    if feature.locked:
        _say(node, pIsLocked=LOCK)
    for name, number in feature.entries.items():
        _say(_node(node, "EnumEntry", name), Value=number)
    _say(node, pValue=behind)
    if feature.kind == "command":
        _say(node, CommandValue=feature.command)
    elif feature.kind == "boolean":
        _say(node, OnValue=1, OffValue=0)
    elif feature.kind in ("integer", "float"):
        _limits(node, feature)
    for selected in feature.selects:
        _say(node, pSelected=selected)
    _register(root, behind, feature, register)


def _limits(node: Xml.Element, feature: Feature) -> None:
    if feature.minimum is not None:
        _say(node, Min=_number(feature.minimum))
    if feature.most:
        _say(node, pMax=feature.most)
    elif feature.maximum is not None:
        _say(node, Max=_number(feature.maximum))
    if feature.increment is not None:
        _say(node, Inc=_number(feature.increment))
    if feature.unit:
        _say(node, Unit=feature.unit)


def _register(root: Xml.Element, name: str, feature: Feature, register: Register) -> None:
    if register.kind == "double":
        node = _node(root, "FloatReg", name)
        _at(node, register, feature)
        _say(node, Endianess="BigEndian")
        return
    node = _node(root, "IntReg" if feature.bits is None else "MaskedIntReg", name)
    _at(node, register, feature)
    if feature.bits is not None:
        _say(node, LSB=feature.bits[1], MSB=feature.bits[0])
    _say(node, Sign="Signed" if register.kind == "signed" else "Unsigned", Endianess="BigEndian")


def _port(feature: Feature) -> str:
    return f"{feature.name}Port" if feature.chunk else "Device"


def _at(node: Xml.Element, register: Register, feature: Feature) -> None:
    # no value is cached: many depend on others, and a reading must show what the device accepted
    _say(
        node,
        Address=f"0x{register.address:x}",
        Length=register.length,
        AccessMode=feature.access,
        pPort=_port(feature),
        Cachable="NoCache",
    )


def _node(parent: Xml.Element, kind: str, name: str) -> Xml.Element:
    return Xml.SubElement(parent, kind, {"Name": name, "NameSpace": "Standard"})


def _say(node: Xml.Element, **values: object) -> None:
    for tag, value in values.items():
        Xml.SubElement(node, tag).text = str(value)


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else repr(value)
