"""XML of robot models: read from a file that nobody has vouched for (no entities, no network, a limited size)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, check_names, check_path
from .files import read_file

__all__ = ["as_text", "find_in_packages", "read_xml"]

_PACKAGE = "package:/"  # a Path keeps one slash of the two
_VERSION = re.compile(rb"""\A(<\?xml\s+version\s*=\s*["'])[\d.]+(["'])""")
_LARGEST = 20_000_000  # bytes; robot models without their meshes stay far below


def read_xml(path: str | Path, root: str | None) -> Any:
    """Root element (lxml) of the XML file, without its comments.

    Raises `InputError` for a file that is missing, a directory, empty, too large, not text, not well-formed, that
    declares a document type or entities (the road to exponential expansion and to foreign files), or whose root
    element is not called `root` (None: whatever it is called).
    """
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    data = _read(Path(path))
    parser = etree.XMLParser(remove_comments=True, remove_pis=True, resolve_entities=False, no_network=True)
    try:
        element = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise InputError(f"{path}: not well-formed XML: {error.msg}") from None
    if element.getroottree().docinfo.doctype:
        raise InputError(_no_doctype(Path(path)))
    if root is not None and element.tag != root:
        other = {"mujoco": "an MJCF: load_mjcf reads it", "robot": "a URDF: load_urdf reads it"}.get(element.tag, "")
        said = f"; it is {other}" if other else ""
        raise InputError(f"{path}: the root element is <{element.tag}>; a <{root}> is expected{said}")
    return element


def as_text(numbers: ArrayLike) -> str:
    """Numbers as an attribute has them, to the last digit."""
    return " ".join(repr(float(x)) for x in np.ravel(np.asarray(numbers)))


def find_in_packages(path: str | Path, packages: Sequence[str | Path]) -> Path:
    """The file that `package://name/rest` means, or the path itself where it does not begin so.

    A folder of `packages` is the package (its own name is `name`) or holds it. Raises `InputError` where none does.
    """
    check_path("path", path)
    check_names("packages", packages)
    text = str(path)
    if not text.startswith(_PACKAGE):
        return Path(path)
    name, _, rest = text[len(_PACKAGE) :].lstrip("/").partition("/")
    for folder in map(Path, packages):
        for place in (folder, folder / name):
            if place.name == name and place.is_dir():
                return place / rest
    searched = ", ".join(map(str, packages)) or "none was given"
    raise InputError(f"{text}: package '{name}' is in none of the package folders ({searched}); give them as packages")


def _read(path: Path) -> bytes:
    data = read_file(path, f"{path}", "a robot model", _LARGEST, (".urdf", ".xml", ".mjcf"))
    data = data.lstrip()  # some files begin with an empty line, which XML forbids
    data = _VERSION.sub(rb"\g<1>1.0\2", data)  # others have a version of their own there: 0.0, 2.0
    if not data:
        raise InputError(f"{path}: the file is empty; a robot model is expected")
    if b"\0" in data:
        raise InputError(f"{path}: not a text file in UTF-8; a robot model is expected")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise InputError(_no_doctype(path))
    return data


def _no_doctype(path: Path) -> str:
    return f"{path}: declares a document type or an entity (<!DOCTYPE, <!ENTITY); these are refused, remove them"
