"""Meshes and textures that a model refers to: robosuite's own, wherever that is installed.

In files such a path begins with ``robosuite/models/assets/``. robosuite's ``edit_model_xml``, which
its scripts and robomimic call, replaces what comes before the last ``robosuite`` of a path by the
place of the package, and so reads this form as it reads absolute paths.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path

from torchrl_bmrl.errors import BMRLError, DataError

_OWN = re.compile(r"(?:.*[/\\])?robosuite[/\\]models[/\\]assets[/\\](.*)")
_FILE = re.compile(r"""(\sfile\s*=\s*(["']))(.*?)(\2)""", re.DOTALL)


def shorten_paths(model: str) -> str:
    """Removes the place of robosuite from the paths of its meshes and textures.

    Args:
        model: MJCF; all else in it stays.

    Example:
        >>> shorten_paths('<mesh file="/home/me/robosuite/models/assets/arm.stl"/>')
        '<mesh file="robosuite/models/assets/arm.stl"/>'
    """

    def short(found: re.Match[str]) -> str:
        own = _OWN.fullmatch(found[3])
        path = f"robosuite/models/assets/{own[1]}".replace("\\", "/") if own else found[3]
        return f"{found[1]}{path}{found[4]}"

    return _FILE.sub(short, model)


def find_assets(model: str) -> str:
    """Returns a model with the paths that its meshes and textures have on this machine.

    A model that came with data reads no other file: it could be anybody's.

    Args:
        model: MJCF whose paths are absolute or those of :func:`shorten_paths`.

    Raises:
        BMRLError: if it is not XML.
        DataError: naming the first file that is not robosuite's, or is missing.

    Example:
        >>> find_assets("<mujoco/>")
        '<mujoco />'
    """
    try:
        root = ET.fromstring(model)
    except ET.ParseError as error:
        raise BMRLError(f"the model of a scene is not XML ({error}); valid: MJCF") from error
    spec = find_spec("robosuite")
    places = (spec and spec.submodule_search_locations) or ()
    folders = [Path(place, "models", "assets").resolve() for place in places]
    for element in root.iter():
        for name, file in list(element.items()):
            if not name.startswith("file"):
                continue
            own = _OWN.fullmatch(file)
            inside = own[1].replace("\\", "/") if own else ""
            found = [(folder / inside).resolve() for folder in folders if own]
            if not any(map(Path.is_relative_to, found, folders)):
                message = "not a file of robosuite, and the model of a scene reads it; valid: "
                raise DataError(file, None, f"{message}files in robosuite/models/assets")
            if not found[0].is_file():
                message = "no such file in the installed robosuite, and the model of a scene reads "
                raise DataError(file, None, f"{message}it; valid: the version that recorded it")
            element.set(name, str(found[0]))
    return ET.tostring(root, encoding="unicode")
