"""What the end of a run says of it."""

from __future__ import annotations

import pytest

from taichi_unifusion.results.record import RunRecord
from taichi_unifusion.results.summary import describe_origin

LEAST = {
    "device_name": "CPU",
    "frames": {"used": 2, "skipped": 0, "interrupted": False, "skipped_frames": []},
    "milliseconds": {},
    "versions": {},
}
RGBD = {"mode": "rgbd"}


@pytest.mark.parametrize(
    ("tracking", "said"),
    [
        (None, "where the poses of the recording have it"),
        ({"mode": "internal"}, "where the poses of the recording have it"),
        ({"mode": "external", "trajectory": "slam.txt"}, "where the poses of slam.txt have it"),
        ({"mode": "internal", "trajectory": "slam.txt"}, "where the poses of slam.txt have it"),
        (RGBD, "the first camera of the recording that was tracked: x to its right, y forwards"),
        ({**RGBD, "merged": []}, "the first camera of the first recording that was tracked: x to"),
        ({"mode": "given", "merged": []}, "where the poses of the first recording have it"),
        ({**RGBD, "joined": {"into": "monday"}}, "that of monday, to which"),
        ({**RGBD, "reposed": "better.txt"}, "where the poses of better.txt have it"),
    ],
)
def test_the_origin_is_where_the_poses_have_it(tracking, said):
    assert describe_origin(RunRecord.from_json({**LEAST, "tracking": tracking})).startswith(said)
