"""The paper's experiments on a scene, each as commands of `unifusion` and the numbers that these
leave in its folder.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from paper_scenes import LISTS, Found, Scene, read_list, replica, scannet, stanford, tum
from paper_truth import write_room_labels

from taichi_unifusion.evaluation.surface import THRESHOLDS
from taichi_unifusion.files.labels import read_class_names
from taichi_unifusion.results.record import read_record
from taichi_unifusion.results.run_folder import RunFolder

EVERY = 10  # "every 10th posed frame" (Sec. VI-E)
WIDE, STRICT = THRESHOLDS  # [m] the paper's, and ours
SAMPLES = 100_000  # points drawn from each surface (Sec. VI-D)

Command = list[str]  # the words after `unifusion`


@dataclass(frozen=True)
class Settings:
    """What a user may choose of an experiment."""

    every: int = EVERY  # frames that are mapped
    tracking: str = "given"  # where poses come from
    features: str = ""  # image encoder; {scene} stands for the scene's name, {area} for its folder
    text: str = ""  # text encoder
    text_options: tuple[str, ...] = ()  # of it
    device: str = "auto"


POSES = {
    "given": "at the recording's poses",
    "internal": "at poses refined against the map (--tracking internal)",
    "rgbd": "at poses tracked from all frames alone (--tracking rgbd)",
}


def mapped(settings: Settings) -> str:
    """Which frames are mapped, and at which poses."""
    return f"{_every(settings.every)} mapped {POSES[settings.tracking]}"


def _every(count: int) -> str:
    if count == 1:
        return "every frame"
    ending = "th" if count // 10 % 10 == 1 else {1: "st", 2: "nd", 3: "rd"}.get(count % 10, "th")
    return f"every {count}{ending} frame"


def _mapped_and_compared(settings: Settings) -> str:
    between = [str(settings.every // 2 + i * settings.every) for i in range(3)]
    return (
        f"{mapped(settings)}; compared with frames that are not, those half-way between: "
        f"{', '.join(between)} ..."
    )


@dataclass(frozen=True)
class Experiment:
    """What is done with every scene."""

    name: str  # of the folder of its results
    find: Callable[..., Found]  # (root, names)
    commands: Callable[[Scene, Path, Path | None, Settings], list[Command]]  # in a folder
    numbers: Callable[[Path], dict[str, Any]]  # from that folder
    settings: Settings = Settings()  # as published
    said: Callable[[Settings], str] = mapped  # what is done, in words
    least_every: int = 1  # more where frames between those that are mapped are compared
    prepare: Callable[[Scene, Path], None] = lambda scene, folder: None


def _map(scene: Scene, folder: Path, config: Path | None, settings: Settings) -> Command:
    """The command that makes the maps."""
    word = "understand" if settings.features else "reconstruct"
    command = [word, scene.format, str(scene.path), "--every", str(settings.every)]
    for option in scene.options:
        command += ["--option", option]
    if settings.features:
        filled = settings.features.replace("{scene}", scene.name).replace("{area}", scene.path.name)
        command += ["--features", filled]
    if settings.tracking != "given":
        command += ["--tracking", settings.tracking]
    if config is not None:
        command += ["--config", str(config)]
    return [*command, "--device", settings.device, "--mesh.formats", "ply", "--out", str(folder)]


def _surface_commands(
    scene: Scene, folder: Path, config: Path | None, settings: Settings
) -> list[Command]:
    evaluate = _evaluate_surface(scene, folder, settings)
    as_published = ["--whole", "--to", "samples", "--out", str(folder / "published.json")]
    seen = ["--out", str(folder / "seen.json")]
    return [
        _map(scene, folder, config, settings),
        [*evaluate, *as_published],
        [*evaluate, *seen],
    ]


def _evaluate_surface(scene: Scene, folder: Path, settings: Settings) -> Command:
    words = ["evaluate", "surface", str(folder), str(scene.truth)]
    return [*words, "--samples", str(SAMPLES), "--device", settings.device]


def _surface_numbers(folder: Path) -> dict[str, Any]:
    """Table I's columns by the published protocol, and what else is of interest."""
    published, seen = _json(folder / "published.json"), _json(folder / "seen.json")
    wide = _score(published, WIDE)
    near, strict = _score(seen, WIDE), _score(seen, STRICT)
    return {
        "Accuracy %": 100 * wide["precision"],
        "Completeness %": 100 * wide["recall"],
        "F1 %": 100 * wide["f1"],
        "of what was seen: accuracy %": 100 * near["precision"],
        "completeness %": 100 * near["recall"],
        "F1 2.5 cm %": 100 * near["f1"],
        "F1 1 cm %": 100 * strict["f1"],
        **_sizes(folder),
    }


def _score(result: Mapping[str, Any], threshold: float) -> Mapping[str, float]:
    return next(score for score in result["scores"] if score["threshold"] == threshold)


def _sizes(folder: Path) -> dict[str, Any]:
    """Megabytes of the maps and of the mesh, milliseconds a frame."""
    record = read_record(RunFolder(folder).record)
    files = {f"{name} map MB": each.file_bytes / 1e6 for name, each in record.maps.items()}
    mesh = RunFolder(folder).mesh
    return {
        **files,
        "mesh MB": mesh.stat().st_size / 1e6 if mesh.exists() else None,
        "ms a frame": record.milliseconds["frame"].mean if "frame" in record.milliseconds else None,
        "frames": record.frames.used,
    }


def _tracking_commands(
    scene: Scene, folder: Path, config: Path | None, settings: Settings
) -> list[Command]:
    poses, scores = RunFolder(folder).tracked_poses, folder / "trajectory.json"
    return [
        _map(scene, folder, config, settings),
        ["evaluate", "trajectory", str(poses), str(scene.truth), "--out", str(scores)],
    ]


def _tracking_numbers(folder: Path) -> dict[str, Any]:
    result = _json(folder / "trajectory.json")
    record = read_record(RunFolder(folder).record)
    verdicts = (record.tracking or {}).get("verdicts", {})
    return {
        "ATE RMSE cm": result["ate_cm"]["rmse"],
        "poses": result["estimated_poses"],
        "of frames": sum(verdicts.values()),
        "tracking s": (record.tracking or {}).get("seconds"),
    }


def _rendering_commands(
    scene: Scene, folder: Path, config: Path | None, settings: Settings
) -> list[Command]:
    device, scores = ["--device", settings.device], str(folder / "rendering.json")
    commands = [
        _map(scene, folder, config, settings),
        ["evaluate", "rendering", str(folder), *device, "--out", scores],
    ]
    if scene.truth is not None:
        seen = ["--out", str(folder / "seen.json")]
        commands.append([*_evaluate_surface(scene, folder, settings), *seen])
    return commands


def _rendering_numbers(folder: Path) -> dict[str, Any]:
    result, seen = _json(folder / "rendering.json"), folder / "seen.json"
    truth = {"F1 1 cm %": 100 * _score(_json(seen), STRICT)["f1"]} if seen.exists() else {}
    return {
        "Depth L1 cm": result["depth_l1_cm"],
        "PSNR dB": result["psnr_db"],
        "SSIM": result["ssim"],
        "coverage %": 100 * result["coverage"],
        "frames compared": [frame["index"] for frame in result["frames"]],
        **truth,
        **_sizes(folder),
    }


@dataclass(frozen=True)
class Classes:
    """The classes of a data set, by the numbers of its labels."""

    file: Path

    @property
    def names(self) -> dict[int, str]:
        return read_class_names(self.file)

    @property
    def unseen(self) -> tuple[int, ...]:
        """Those that the compared methods did not train with."""
        numbers = {name: number for number, name in self.names.items()}
        listed = read_list(self.file.with_name(f"{self.file.stem}_unseen.txt"))
        return tuple(numbers[name] for name in listed)


SCANNET20, S3DIS13 = Classes(LISTS / "scannet20.txt"), Classes(LISTS / "s3dis13.txt")


def _segmentation_commands(
    classes: Classes,
) -> Callable[[Scene, Path, Path | None, Settings], list[Command]]:
    def commands(
        scene: Scene, folder: Path, config: Path | None, settings: Settings
    ) -> list[Command]:
        truth = _labels_file(folder) if scene.format == "2d3ds" else scene.truth
        segment = ["segment", str(folder), "--labels", str(classes.file), "--truth", str(truth)]
        if settings.text:
            segment += ["--text", settings.text]
        device = ["--device", settings.device]
        return [
            _map(scene, folder, config, settings),
            [*segment, *settings.text_options, *device],
        ]

    return commands


def _segmentation_numbers(folder: Path) -> dict[str, Any]:
    """Counts of points by true and given class: tables are made of their sums over scenes."""
    scores = _json(RunFolder(folder).segmentation)["scores"]
    return {
        "mean IoU %": 100 * scores["mean_iou"],
        "points": scores["points"],
        "confusion": scores["confusion"],
        **_sizes(folder),
    }


def _labels_file(folder: Path) -> Path:
    return folder / "truth.ply"


def _prepare_room(scene: Scene, folder: Path) -> None:
    if scene.truth is not None:
        write_room_labels(scene.truth, S3DIS13.names, _labels_file(folder))


def _labelled_scannet(root: Path, names: Any = None) -> Found:
    return scannet(root, names, labels=True)


def _json(path: Path) -> Any:
    return json.loads(path.read_text())


SURFACE = Experiment("scannet-surface", scannet, _surface_commands, _surface_numbers)
TRACKING = Experiment(
    "tum-tracking", tum, _tracking_commands, _tracking_numbers, Settings(tracking="rgbd")
)
RENDERING = Experiment(
    "replica-rendering",
    replica,
    _rendering_commands,
    _rendering_numbers,
    Settings(tracking="rgbd"),
    _mapped_and_compared,
    least_every=2,
)
SCANNET_CLASSES = Experiment(
    "scannet-classes",
    _labelled_scannet,
    _segmentation_commands(SCANNET20),
    _segmentation_numbers,
)
S3DIS_CLASSES = Experiment(
    "s3dis-classes",
    stanford,
    _segmentation_commands(S3DIS13),
    _segmentation_numbers,
    Settings(every=1),  # its images overlap little
    prepare=_prepare_room,
)
