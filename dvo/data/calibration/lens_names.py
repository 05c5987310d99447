"""Names of lens models in calibration files, and which keys of a file speak of a lens."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from dvo.geometry.camera import DistortionModel

PINHOLE = "pinhole"
"""A projection without a word about distortion."""

_NAMES: dict[DistortionModel, str] = {
    "none": "none pinholenodistortion rectified linear undistorted nodistortion ideal",
    "radtan": "radtan radtan4 radtan5 radtan8 radialtangential radialtangential8 plumbbob opencv fullopencv brown "
    "brownconrady rationalpolynomial rational pinholeradtan pinholeradtan8 pinholeradialtangential thinprism "
    "rationalthinprism radial simpleradial pinholefull",
    "fisheye": "fisheye equidistant equi kannalabrandt kannalabrandt4 kannalabrandt8 kb kb4 kb8 opencvfisheye "
    "pinholeequidistant pinholeequi pinholefisheye equidistantfisheye kannala",
    "ucm": "ucm unified unifiedcameramodel",
    "mei": "mei omninone omni omnidirectional cata catadioptric omniradtan omnidir unifiedprojection",
    "eucm": "eucm eucmnone extendedunified enhancedunified enhancedunifiedcameramodel extendedunifiedcameramodel",
    "double_sphere": "ds dsnone doublesphere",
    "fov": "fov atan pinholeatan pinholefov fieldofview",
    "thin_prism_fisheye": "thinprismfisheye",
    "fisheye624": "fisheye624 radtanthinprismfisheye fisheyeradtanthinprism",
}
_MODELS: dict[str, str] = {name: model for model, names in _NAMES.items() for name in names.split()}
_MODELS |= dict.fromkeys(["pinhole", "perspective", "simplepinhole", "pinholecamera"], PINHOLE)
_FLAGS = frozenset(["true", "false", "yes", "no", "on", "off", "0", "1"])

_WORDS = re.compile(
    r"(disto|fisheye|lens|skew|radial|tangential|prism|kannala|coef|mirror|poly|omni|rational|warp|barrel|pincushion|"
    r"aberration|curvature|kappa|brown|conrady|anamorph|shear|optic|nonlinear|deform|bend|tilt|division|squeeze|"
    r"equidist|radtan|plumb|scaramuzza|equirect|wide_?angle)"
)
_WHOLE = frozenset(
    [
        "d",
        "dist",
        "dists",
        "xi",
        "alpha",
        "beta",
        "omega",
        "kc",
        "kd",
        "tau",
        "taux",
        "tauy",
        "tau_x",
        "tau_y",
        "alpha_c",
        "radtan",
        "cam_dist",
        "affine",
        "c_d_e",
    ]
)
_SCALAR = re.compile(  # k1, p2, d0; not matrices P1 or D2, nor t_00 and r_12 of a pose
    r"(k|p|s|d|b|xi|tau|kc|lambda|mu|nu|a|e)_?\d{1,2}|[tr]_?\d"
)
_KIND = re.compile(
    r"(fisheye|equisolid|equidistant|stereographic|orthographic|equirect|panoram|kannala|brown.?conrady|plumb.?bob|"
    r"radial.?tangential|radtan|cubemap|catadioptric)"
)
_OTHER = re.compile(  # keys that speak of something else though they have such a word
    r"(polymorph|per_frame|undist|rectif|error|flag|name|file|path|topic|mask|serial|facing|distance|iter|thresh|min_|max_|uncert|std|stdev|"
    r"covar|sigma|weight|optical_?flow|optimi|criteria|aspect|rms|imu|gyro|acc)"
)
_BENIGN = re.compile(  # lists of as many numbers as a lens may have coefficients
    r"(^t_|^r?t[a-z]{0,2}$|_to_|[a-z]2[a-z]|^tf|transf|extrin|^r$|^r_|^r\d|rot|rect|^p$|^p_|^p\d|^q(_|$)|proj|trans|quat|pose|posit|orient|roi|crop|imu|"
    r"body|accel|gyro|noise|bias|grav|euler|rpy|xyz|error|reproj|view|std|cov|shift|rate|mask|border|bound|colou?r|rgb|"
    r"scale|offset|mean|backgr|window|grid|pattern|board|square|overlap|center|centre|viewer|line|point|range|depth|"
    r"size|resol|shape|time|stamp|frame|matrix|ids?$|aabb|box|plane|white|exposure|gain|norm)"
)


def bare(name: str) -> str:
    """A key or the name of a model without case, blanks and punctuation.

    Args:
        name: as in a file.
    """
    return re.sub(r"[^a-z0-9]", "", name.lower())


def model_of(name: Any) -> str | None:
    """Lens model that a file names.

    Args:
        name: value in the file.

    Returns:
        A :data:`dvo.geometry.camera.DistortionModel`, or :data:`PINHOLE`; None for an unknown name.
    """
    known = bare(str(name))
    return _MODELS.get(known) or _MODELS.get(known.removeprefix("distortion")) or (PINHOLE if not known else None)


def says_nothing(value: Any) -> bool:
    """True for a value that states no lens: none, false, zeros, an empty list, a text such as ``none``.

    Args:
        value: of an entry.
    """
    if value is None or value is False:
        return True
    if isinstance(value, str):
        return bare(value) in (
            "",
            "none",
            "no",
            "false",
            "off",
            "0",
            "na",
            "null",
            "pinhole",
            "rectified",
            "perspective",
        )
    try:
        return not np.array(value, dtype=np.float64).any()
    except (TypeError, ValueError, OverflowError):
        return False


def is_flag(value: Any) -> bool:
    """True for a truth value, as number, text or bool.

    Args:
        value: of an entry.
    """
    return str(value).strip().lower().removesuffix(".0") in _FLAGS


def looks_like_a_lens(key: str, value: Any) -> bool:
    """True for an entry that may state the distortion of a lens.

    Args:
        key: its name, without those of the mappings that it stands in.
        value: of any kind.
    """
    if says_nothing(value):
        return False
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", key).lower().replace("-", "_").replace(" ", "_").replace(".", "_")
    name = re.sub(r"^(?:cam|camera)_?\d*_(?=.)", "", name)
    if _OTHER.search(name):
        return False
    if isinstance(value, str) and _KIND.search(value.lower()):
        return True
    parts = name.split("_")
    if _WORDS.search(name) or name in _WHOLE or bare(name) in _WHOLE or "dist" in parts or "dist" in parts[-1][:4]:
        return True
    numbers = _flat(value)
    if name in ("k", "ks", "p", "ps") and isinstance(value, list) and numbers is not None:  # no matrix
        return len(numbers) <= (6 if name[0] == "k" else 2)
    if numbers is not None and len(numbers) <= 3:
        return _SCALAR.fullmatch(name) is not None
    return numbers is not None and len(numbers) in (4, 5, 8, 12, 14) and not _BENIGN.search(name)


def _flat(value: Any) -> np.ndarray | None:
    if isinstance(value, str):
        return None
    try:
        return np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        return None
