"""Intrinsics of another resolution or camera: by the principal point, and by the focal length at which
frames agree.
"""

from __future__ import annotations

import numpy as np

from ...types import PinholeCamera
from ..plausibility import OFF_CENTRE
from .evidence import Change, Evidence
from .finding import Finding
from .fix import Fix
from .sampling import Sample

FOCALS = np.geomspace(0.4, 2.5, 19)  # factors of another resolution's intrinsics
LEAST_FOCAL = 1.12  # factor
SAME_FACTOR = 0.1  # relative, of the two axes' factors and the focal length's
# share of the image from which on a principal point may tell of another resolution, if frames agree
SOMEWHAT_OFF = 0.05


def off_centre(sample: Sample) -> Finding | None:
    """Intrinsics of another resolution, by where the principal point lies."""
    if not sample.frames:
        return None
    camera = sample.frames[0].camera
    shares = np.array([(camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height])
    if np.abs(shares - 0.5).max() <= OFF_CENTRE:
        return None
    factors = 0.5 / shares
    told = _told(camera)
    if abs(factors[0] / factors[1] - 1) > SAME_FACTOR:
        return Finding(
            "intrinsics",
            f"{told}: these are another camera's intrinsics, or of images that were cut",
            "--intrinsics FX,FY,CX,CY of the depth images",
        )
    return _of_images(camera, round_factor(float(factors.mean())), told)


def _told(camera: PinholeCamera) -> str:
    return (
        f"the principal point ({camera.cx:g}, {camera.cy:g}) is not near the middle of the "
        f"{camera.width}x{camera.height} images"
    )


def _of_images(camera: PinholeCamera, factor: float, told: str) -> Finding:
    """That intrinsics have to be multiplied by a factor, and how that was told."""
    mended = times(camera, factor)
    size = f"{round(camera.width / factor)}x{round(camera.height / factor)}"
    return Finding(
        "intrinsics",
        f"{told}: these are intrinsics of {size} images",
        f"--intrinsics {listed(mended)}",
        Fix({"intrinsics": [float(f"{number:.6g}") for number in mended.intrinsics]}),
    )


def round_factor(factor: float) -> float:
    """A ratio of two usual resolutions near the factor, or the factor."""
    usual = [a / b for b in (1, 2, 3, 4, 5, 9) for a in (1, 2, 3, 4, 5, 8, 9)]
    near = min(usual, key=lambda ratio: abs(np.log(ratio / factor)))
    return near if abs(near / factor - 1) < 0.06 else factor


def times(camera: PinholeCamera, factor: float) -> PinholeCamera:
    """The camera with the intrinsics of images so much larger."""
    return PinholeCamera(
        camera.width,
        camera.height,
        camera.fx * factor,
        camera.fy * factor,
        min(max((camera.cx + 0.5) * factor - 0.5, 0), camera.width),
        min(max((camera.cy + 0.5) * factor - 0.5, 0), camera.height),
    )


def with_focal(camera: PinholeCamera, factor: float) -> PinholeCamera:
    """The camera with another focal length."""
    fx, fy = camera.fx * factor, camera.fy * factor
    return PinholeCamera(camera.width, camera.height, fx, fy, camera.cx, camera.cy)


def listed(camera: PinholeCamera) -> str:
    """The intrinsics as the option takes them."""
    return ",".join(f"{number:.6g}" for number in camera.intrinsics)


def other_focal(evidence: Evidence, centre: Finding | None) -> list[tuple[Change, Finding]]:
    """Another focal length with which the frames agree best, or the intrinsics that the principal
    point tells of.
    """
    camera = evidence.near.views[0].camera
    if any(view.camera != camera for view in (*evidence.near.views, *evidence.wide.views)):
        return []
    if centre is not None:
        numbers = centre.fix.recording.get("intrinsics")
        if numbers is None:
            return []
        return [(Change(camera=PinholeCamera(camera.width, camera.height, *numbers)), centre)]
    named = _other_resolution(evidence, camera)
    best = evidence.best(lambda factor: Change(camera=with_focal(camera, factor)), FOCALS, log=True)
    if max(best, 1 / best) < LEAST_FOCAL:
        return named
    mended = with_focal(camera, best)
    change = Change(camera=mended)
    sentence = (
        f"{evidence.agreement(change)} with a focal length of {mended.fx:.4g} pixels instead of {camera.fx:.4g}: the "
        "intrinsics are of another camera or resolution"
    )
    fix = Fix({"intrinsics": [float(f"{number:.6g}") for number in mended.intrinsics]})
    return [
        *named,
        (change, Finding("intrinsics", sentence, f"--intrinsics {listed(mended)}", fix)),
    ]


def _other_resolution(evidence: Evidence, camera: PinholeCamera) -> list[tuple[Change, Finding]]:
    """The intrinsics of which a principal point tells that lies no farther off than cameras' own may."""
    factors = 0.5 / np.array([(camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height])
    factor = round_factor(float(factors.mean()))
    if np.ptp(factors) > SAME_FACTOR or abs(0.5 / factor - 0.5) < SOMEWHAT_OFF:
        return []
    change = Change(camera=times(camera, factor))
    return [
        (change, _of_images(camera, factor, f"{evidence.agreement(change)} and {_told(camera)}"))
    ]
