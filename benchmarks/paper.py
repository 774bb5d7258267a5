"""The experiments of the Uni-Fusion paper (Sec. VI), a command each: the paper's rows beside ours.

    python benchmarks/paper.py I PATH/scannet --out results/paper
    python benchmarks/paper.py II PATH/tum
    python benchmarks/paper.py III PATH/Replica --methods ours published
    python benchmarks/paper.py V PATH/scannet PATH/2d3ds --features folder:PATH/{scene} --text embeddings:names.npz
    python benchmarks/paper.py VIII --device cuda
    python benchmarks/paper.py fig13

Roots are folders as the data sets unpack; docs/paper.md shows each. Every scene runs in processes of
its own, by commands of `unifusion` that are printed; its numbers go to a JSON file under --out, so
that what is done is not run again, and what fails is named while the others go on. At the end come
the table, table_N.json and table_N.png.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import paper_pictures as pictures
from paper_experiments import S3DIS_CLASSES, SURFACE, Experiment, Settings
from paper_methods import METHODS, methods_of
from paper_report import markdown, report
from paper_runs import STOPPED, Results, column, read_results, run_scenes
from paper_scenes import read_list
from paper_tables import NOTHING, TABLES, ByExperiment, Table, paper_rows, summary

from taichi_unifusion.errors import InputError, UniFusionError
from taichi_unifusion.files.atomic import check_writable, write_text

FIGURES = {  # name -> study of ablation.py, what it shows
    "fig11": ("encoding", "surface from samples beside it against normals as derivatives"),
    "fig12": ("voxel-size", "surface by voxel size, 2 to 10 cm"),
    "fig13": ("kernel", "error of the kernel's approximation by eigenpairs and anchors"),
}
TIMES = "milliseconds a frame of 1280 x 720, by map, and of tracking"


def experiment_of(table: Table, root: Path) -> Experiment:
    """The experiment that a root is for: an area of 2D-3D-S tells S3DIS from ScanNet."""
    if len(table.experiments) == 1:
        return table.experiments[0]
    areas = any(root.glob("area_*"))
    return next(each for each in table.experiments if (each is S3DIS_CLASSES) == areas)


def roots_by_experiment(table: Table, roots: Sequence[Path]) -> dict[Experiment, Path]:
    """What is run in which root; raises InputError for two roots of one data set."""
    found: dict[Experiment, Path] = {}
    for root in roots:
        experiment = experiment_of(table, root)
        if experiment in found:
            raise InputError(
                f"{found[experiment]} and {root} are both taken for {experiment.name}; give one "
                "root a data set"
            )
        found[experiment] = root
    return found


def run_table(table: Table, options: argparse.Namespace) -> int:
    """Run the scenes of all roots under all methods, then write and print the table."""
    methods, out = methods_of(options.methods), check_writable(options.out)
    names = read_list(options.list) if options.list else options.scenes
    found: dict[str, dict[str, Results]] = {}
    for experiment, root in roots_by_experiment(table, options.roots).items():
        here = experiment.find(root, names)
        settings = settings_of(experiment, options)
        print(f"{root}: {len(here.scenes)} scenes, {len(here.missing)} on the list but not here")
        for method in methods:
            folder = out / experiment.name / method.name
            results = run_scenes(
                experiment, here.scenes, folder, method, settings, options.keep_maps
            )
            results.missing = here.missing
            found.setdefault(method.name, {})[experiment.name] = results
    for method, results in found.items():  # the halves of Table V may be run one by one
        for experiment in table.experiments:
            if experiment.name not in results:
                results[experiment.name] = read_results(out / experiment.name / method)
    write_text(
        out / f"table_{table.number}.json", json.dumps(summary(table, found), indent=1) + "\n"
    )
    draw(table, found, out / f"table_{table.number}.png")
    print(report(table, found))
    return 0 if not any(r.failed for each in found.values() for r in each.values()) else 1


def settings_of(experiment: Experiment, options: argparse.Namespace) -> Settings:
    """The experiment's settings with what the user chose."""
    chosen: dict[str, Any] = {
        each.name: getattr(options, each.name)
        for each in fields(Settings)
        if getattr(options, each.name, None) is not None
    }
    more = [("--names", "names"), ("--tokenizer", "tokenizer")]
    words = [
        w for flag, n in more if getattr(options, n, None) for w in (flag, getattr(options, n))
    ]
    settings = replace(experiment.settings, **chosen, text_options=tuple(words))
    if settings.every < experiment.least_every:
        raise InputError(
            f"--every {settings.every}: {experiment.name} compares frames between those that are mapped; "
            f"give {experiment.least_every} or more"
        )
    return settings


def draw(table: Table, found: Mapping[str, ByExperiment], path: Path) -> None:
    """Table I as curves over scenes (Fig. 8), others as bars."""
    header, *paper = paper_rows(table.number)
    ours = [row for name, each in found.items() for row in table.rows(name, each, header)]
    colors = pictures.colors_of(list(dict.fromkeys(row[0] for row in paper)), list(found))
    panels = []
    if table.experiments == (SURFACE,):
        for i, name in enumerate(header[1:], start=1):
            values = {
                method: [v for v in column(each[SURFACE.name], name) if v is not None]
                for method, each in found.items()
            }
            values = {method: each for method, each in values.items() if each}
            levels = {row[0]: float(row[i]) for row in paper}
            panels.append(pictures.curves(name, values, levels, colors))
    else:
        first = 2 if header[1] == "metric" else 1
        titles = dict.fromkeys(row[1] for row in paper) if first == 2 else (table.title,)
        for title in titles:
            kept = [row for row in (*paper, *ours) if first == 1 or row[1] == title]
            values = {
                row[0]: [None if c == NOTHING else float(c) for c in row[first:]] for row in kept
            }
            panels.append(pictures.bars(title, header[first:], values, colors))
    pictures.write_panels(path, panels)


def run_times(options: argparse.Namespace) -> int:
    """Table VIII."""
    import paper_times

    header, *rows = paper_rows("VIII")
    found = paper_times.milliseconds(options.root, options.device, options.frames)
    device, ms = found["device"], found["ms"]
    rows.append([f"ours, {device}", *(format(ms[name], ".1f") for name in header[1:])])
    out = check_writable(options.out)
    write_text(
        out / "table_VIII.json", json.dumps({"header": header, "rows": rows, **found}, indent=1)
    )
    colors = pictures.colors_of([rows[0][0]], [rows[1][0]])
    values = {row[0]: list(map(float, row[1:])) for row in rows}
    pictures.write_panels(
        out / "table_VIII.png", [pictures.bars(TIMES, header[1:], values, colors)]
    )
    print(f"\nTable VIII: {TIMES}\n\n{markdown([header, *rows])}")
    print(f"\nall at once, Pipeline.step with tracking left out: {ms['all at once']:.1f} ms")
    return 0


def run_figure(options: argparse.Namespace) -> int:
    """A study of ablation.py."""
    import ablation

    study, _ = FIGURES[options.table]
    ablation.run([study], options.scene, options.data, options.frames, check_writable(options.out))
    return 0


def parser() -> argparse.ArgumentParser:
    whole = argparse.ArgumentParser(
        prog="paper.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = whole.add_subparsers(
        dest="table", required=True, metavar="TABLE", title="experiments of the paper"
    )
    for table in TABLES.values():
        _add_table(commands, table)
    times = commands.add_parser("VIII", help=TIMES, description=f"Table VIII: {TIMES}.")
    times.add_argument(
        "root",
        nargs="?",
        type=Path,
        help="the .mkv of an Azure Kinect (default: the synthetic room)",
    )
    times.add_argument("--frames", type=int, default=12, help="frames to take (default: 12)")
    times.set_defaults(run=run_times)
    _add_common(times)
    for name, (_, title) in FIGURES.items():
        figure = commands.add_parser(name, help=title, description=f"{name}: {title}.")
        figure.set_defaults(run=run_figure, scene="synthetic", data=None, frames=None)
        if name != "fig13":  # of the kernel alone
            _add_scene(figure)
        figure.add_argument("--out", type=Path, default=Path("results/paper"), metavar="DIR")
    return whole


def _add_scene(figure: argparse.ArgumentParser) -> None:
    from quality import DATA, SCENES

    figure.add_argument("--scene", choices=list(SCENES), metavar="SCENE", help=", ".join(SCENES))
    figure.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    figure.add_argument("--frames", type=int, help="about how many frames to fuse")


def _add_table(commands: Any, table: Table) -> None:
    one = commands.add_parser(
        table.number,
        help=table.title,
        description=f"Table {table.number}: {table.title}. docs/paper.md says what is measured.",
    )
    several = len(table.experiments) > 1
    one.add_argument(
        "roots",
        nargs="+" if several else 1,
        type=Path,
        metavar="ROOT",
        help="folder of the data set" + (", of one or of both" if several else ""),
    )
    one.add_argument("--scenes", nargs="+", metavar="NAME", help="some scenes only")
    one.add_argument("--list", type=Path, metavar="FILE", help="a list of scenes instead of ours")
    one.add_argument(
        "--methods",
        nargs="+",
        default=["ours"],
        metavar="METHOD",
        help=f"{', '.join(METHODS)} or FILE.yaml (default: ours)",
    )
    one.add_argument("--every", type=int, metavar="N", help="map every N-th frame")
    if table.number == "III":  # of Table II it is what is measured
        one.add_argument(
            "--tracking", choices=("given", "internal", "rgbd"), help="camera poses (default: rgbd)"
        )
    if table.number in ("V", "VI", "VII"):
        one.add_argument(
            "--features",
            required=True,
            metavar="ENCODER",
            help="folder:PATH/{scene} of OpenSeg's or LSeg's files, clip:FOLDER, ...; {scene} and "
            "{area} are filled in",
        )
        one.add_argument("--text", metavar="ENCODER", help="embeddings:FILE, clip:FOLDER, ...")
        one.add_argument("--names", metavar="FILE", help="of the vectors of an embeddings file")
        one.add_argument("--tokenizer", metavar="FILE", help="of a text encoder in an ONNX file")
    one.add_argument("--keep-maps", action="store_true", help="do not remove a scene's maps")
    one.set_defaults(run=lambda options, table=table: run_table(table, options))
    _add_common(one)


def _add_common(one: argparse.ArgumentParser) -> None:
    one.add_argument("--device", default="auto", choices=("auto", "cuda", "cpu"))
    one.add_argument(
        "--out", type=Path, default=Path("results/paper"), metavar="DIR", help="for all results"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    try:
        return options.run(options)
    except KeyboardInterrupt:
        print("paper: stopped; the same command goes on with what is not done yet")
        return STOPPED
    except UniFusionError as error:
        raise SystemExit(f"paper: {error}") from None


if __name__ == "__main__":
    raise SystemExit(main())
