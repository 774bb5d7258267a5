"""The names that are promised: what `__all__` of the public packages holds changes only on purpose."""

from __future__ import annotations

import importlib
import inspect

import pytest

PUBLIC = {
    "taichi_unifusion": """
        Config Frame Mesh PinholeCamera Pipeline PointCloud PropertyMap SurfaceMap
        Trajectory UniFusionError __version__ init load_config load_map open_dataset
        preprocess warm_up
    """,
    "taichi_unifusion.datasets": """
        ColorCamera ColorEstimate Dataset DatasetView FORMATS FormatOption
        estimate_color_camera format_options open_dataset parse_options
    """,
    "taichi_unifusion.evaluation": """
        RenderingResult SegmentationResult SurfaceResult TrajectoryResult Viewpoints
        evaluate_rendering evaluate_segmentation evaluate_surface evaluate_trajectory
        transfer_labels
    """,
    "taichi_unifusion.language": """
        EncoderChoice IMAGE_ENCODERS ImageEncoder TEXT_ENCODERS TextEncoder feature_image
        make_image_encoder make_text_encoder unit_length
    """,
    "taichi_unifusion.maps": """
        BaseMap FeatureMap FeatureSettings Integration MapSettings PropertyGroup PropertyMap
        PropertySettings SurfaceMap SurfaceSettings load_map
    """,
    "taichi_unifusion.properties": """
        Look PROPERTIES SurfaceProperty make_property
    """,
    "taichi_unifusion.results": """
        Results Run RunFolder RunRecord inspect read_record read_run write_results
    """,
    "taichi_unifusion.tracking": """
        CurrentPoses Mode PoseSource TRACKERS TrackedFrame Tracker TrackingResult TrackingSettings
        Verdict check_poses make_tracker track
    """,
}


@pytest.mark.parametrize("package", PUBLIC)
def test_the_public_names_are_those_promised(package: str) -> None:
    module = importlib.import_module(package)
    assert sorted(module.__all__) == PUBLIC[package].split()


@pytest.mark.parametrize("package", PUBLIC)
def test_every_public_name_is_there_and_says_what_it_is(package: str) -> None:
    module = importlib.import_module(package)
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{package}.{name} has no docstring"
