"""What `reconstruct` and `understand` do with a recording: find its poses, and fuse its frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..datasets import Dataset
from ..tracking import track
from ..tracking.sequence import PosedFrames
from .following import in_one_pass, keep_store, keep_tracking, map_in_one_pass, open_store
from .into import Addition, placed, remembered
from .on_workers import run_on_workers
from .options import source_of
from .resuming import make_pipeline, registered
from .run import Mapped, Run
from .terminal import frame_progress
from .viewing import map_frames

if TYPE_CHECKING:
    from ..results.record import ColorRecord, Source


def map_recording(
    recording: Dataset, color: ColorRecord, run: Run
) -> tuple[Mapped, Dataset, Source]:
    """Track and map; also the frames that were to be mapped, and what the record keeps of them."""
    options, folder, saver = run.options, run.folder, run.saver
    every, wanted = options.recording.every, options.recording
    if not options.cluster.wanted and in_one_pass(recording, options):
        recording, color = registered(recording, color, saver)
        frames = recording[::every]
        source = source_of(wanted, len(frames), color)
        saver.describe(source, {"mode": options.poses.mode, "passes": 1})
        return map_in_one_pass(recording, run), frames, source
    tracking, tracked, written, added = None, None, (), None
    if options.poses.tracked:
        recording, tracking = _track(recording, run)
    recording, color = registered(recording, color, saver)
    if options.output.into is not None:
        added = placed(recording, options, saver, run.stop)
        recording, tracking = added.frames, {**(tracking or {"mode": "given"}), **added.details}
    if options.poses.tracked:
        assert isinstance(recording, PosedFrames)
        tracked, written = recording.tracking.frames, folder.tracking_files
    frames = recording[::every]
    source = replace(source_of(wanted, len(frames), color), before=added.sources if added else ())
    saver.describe(source, tracking)
    if options.cluster.wanted:
        poses = tracked and tracked[::every]
        mapped = Mapped(
            *run_on_workers(
                frames,
                source,
                poses,
                options.settings,
                options.cluster,
                folder,
                run.stop,
                encoder=options.image_encoder,
                resume=options.output.resume,
            ),
            None,
            (),
        )
    else:
        mapped = _map(frames, run, added)
        if added and written:
            written = written if mapped.run.steps else ()
            if written:  # now: in the folder of the map itself that ends its record
                keep_tracking(folder, added.frames.tracking)
    return replace(mapped, tracking=tracking, written=(*written, *mapped.written)), frames, source


def _map(frames: Dataset, run: Run, added: Addition | None) -> Mapped:
    """Fuse frames at the poses that they have, to maps that are there if they are added to some."""
    options, folder, saver = run.options, run.folder, run.saver
    output, store = options.output, None
    if output.keep_windows or (added and added.windows and not output.forget):
        settings = options.settings
        store = open_store(folder, output, settings, moves=False, added=added, saver=saver)
    pipeline = make_pipeline(options, run.encoder, folder, saver, store)
    done = map_frames(
        pipeline,
        frames,
        len(frames),
        strict=options.recording.strict,
        stop=run.stop,
        watcher=run.watcher,
        on_border=saver.at_border,
        before=saver.resumed and saver.resumed.so_far,
    )
    kept = remembered(folder, frames, done, store, added, pipeline.config, run.stop)
    return Mapped(pipeline, done, None, (*keep_store(folder, store, output), *kept))


def _track(recording: Dataset, run: Run) -> tuple[PosedFrames, Mapping[str, Any]]:
    """The frames with the poses that are asked for, and what to say of them in the record.

    All frames are tracked, whatever --every leaves for the map: small steps are easier. Poses are
    written at once, so that they outlive whatever comes after; those of a recording that is added to a
    map wait until its place is known.
    """
    from .. import runtime

    options, saver = run.options, run.saver
    if saver.tracked is not None:
        posed = PosedFrames(recording, saver.tracked)
        return posed, {"mode": options.poses.mode, **posed.tracking.details}
    poses, settings = options.poses, options.settings
    runtime.init(settings.device, threads=settings.threads or None)
    with frame_progress(len(recording)) as on_frame:
        posed = track(
            recording,
            settings.tracking,
            settings.preprocess,
            mode=poses.mode,
            trajectory=poses.trajectory,
            interpolate=poses.interpolate,
            body_camera=poses.body_camera,
            max_difference=options.recording.max_difference,
            stop=run.stop,
            on_frame=on_frame,
        )
    if options.output.into is None:
        keep_tracking(run.folder, posed.tracking)
    if not posed.tracking.interrupted:
        saver.save_tracking(posed.tracking)
    return posed, {"mode": poses.mode, **posed.tracking.details}
