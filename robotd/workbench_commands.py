"""The commands of `robotd-solver workbench`; each takes the parsed command line and returns an exit code."""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .files import write_atomic
from .footage import Shot
from .recording import read_contents, recover as make_whole
from .records import Flash
from .toml_edit import toml
from .workbench import pictures
from .workbench.detectors import Detector, make_detector, plain_settings, read_settings
from .workbench.export import export_frames, export_recording
from .workbench.player import Player, mean_picture, write_picture, write_video
from .workbench.score import Score
from .workbench.sequence import Tagged, appearances, judge_clips, measure, open_all, open_tagged, steps
from .workbench.tags import NEAR_PX, Tag, add_tag, load_tags, remove_tags, save_tags, tags_path
from .workbench.trace import Trace
from .workbench.tune import Trial, parse_range, score_set, shared, tune as search

QUANTILES = (5, 25, 50, 75, 95)  # percent of what is told of a distribution
_LATE_S = 1.0  # after the last frame, that may still be asked for


def info(arguments: argparse.Namespace) -> int:
    """What footage holds, how it was taken, and its marks."""
    entries = []
    for one in _open_all(arguments):
        times, size = [], None
        for _, shot in one.frames():
            times.append(shot.t)
            size = shot.image.shape[1::-1]
        gaps = np.diff(times)
        entry: dict[str, Any] = {
            "footage": str(one.footage.path),
            "camera": one.camera,
            "frames": len(times),
            "size": list(size) if size is not None else None,
            "seconds": round(times[-1], 6) if times else 0.0,
            "fps": round(float(1.0 / np.median(gaps)), 3) if len(gaps) else None,
            "longest_gap_s": round(float(gaps.max()), 4) if len(gaps) else None,
            "tags": {kind: sum(tag.kind == kind for tag in one.tags) for kind in ("label", "reflection", "ignore")},
            "taken": one.taken,
        }
        if one.camera is not None:
            contents = read_contents(one.footage.path)
            entry["whole"] = contents.is_whole
            entry["about"] = contents.about
            entry["modes"] = [dict(way) for way in contents.cameras.get(one.camera, ())]
        entries.append(entry)
        rate = f"{entry['fps']:g} fps, longest gap {entry['longest_gap_s']:g} s" if len(gaps) else "one frame"
        width, height = entry["size"] or (0, 0)
        whole = "" if entry.get("whole", True) else "; was cut off: robotd-solver workbench recover"
        _say(
            arguments,
            f"{one.name}: {len(times)} frames of {width}x{height}, {entry['seconds']:.2f} s, {rate},"
            f" {entry['tags']['label']} labels marked{whole}",
        )
    return _done(arguments, {"footage": entries})


def play(arguments: argparse.Namespace) -> int:
    """Frames with marks and findings: in real time, frame by frame, or into a video."""
    tagged = _open(arguments)
    detector = _detector(arguments, tagged) if arguments.detector is not None else None
    if arguments.video is not None:
        count = write_video(arguments.video, tagged, detector, arguments.since, arguments.until)
        _say(arguments, f"{arguments.video}: {count} frames")
        return _done(arguments, {"video": str(arguments.video), "frames": count})
    shown: list[dict[str, Any]] = []

    def tell(number: int, shot: Shot, seen: pictures.Seen) -> None:
        found = None if seen.flashes is None else len(seen.flashes)
        shown.append({"frame": number, "t": round(shot.t, 6), "flashes": found})
        _say(arguments, f"frame {number}  {shot.t:8.3f} s" + (f"  {found} flashes" if found is not None else ""))

    player = Player(
        tagged, lambda: _detector(arguments, tagged) if detector is not None else None, tell, arguments.view
    )
    if arguments.step:
        player.step(sys.stdin, arguments.since, arguments.until)
    else:
        asyncio.run(player.play(arguments.since, arguments.until, arguments.speed))
    return _done(arguments, {"frames": shown})


def tag(arguments: argparse.Namespace) -> int:
    """Add, remove, propose and draw marks."""
    tagged = _open(arguments)
    path = tags_path(arguments.footage)
    every = load_tags(path)
    first = next((shot for _, shot in tagged.frames()), None)
    if first is None:
        raise InputError(f"{arguments.footage}: holds no image")
    size = first.image.shape[1], first.image.shape[0]
    before = list(every)
    mine = [one for one in every if one.camera in (None, tagged.camera)]
    chosen = remove_tags(mine, arguments.remove)
    every = [one for one in every if one not in mine or one in chosen]
    for u, v in arguments.add:
        new = Tag(
            *(u, v, arguments.kind, tagged.camera, arguments.label, arguments.since, arguments.until),
            arguments.radius or NEAR_PX,
        )
        every = add_tag(every, new, size)
    proposals: list[Flash] = []
    if arguments.propose or arguments.accept or arguments.accept_all:
        proposals = _proposals(arguments, tagged, every)
        wanted = range(1, len(proposals) + 1) if arguments.accept_all else arguments.accept
        unknown = [number for number in wanted if not 1 <= number <= len(proposals)]
        if unknown:
            raise InputError(f"no proposal {', '.join(map(str, unknown))}; there are {len(proposals)}")
        for number in wanted:
            flash = proposals[number - 1]
            every = add_tag(every, Tag(round(float(flash.u), 2), round(float(flash.v), 2), camera=tagged.camera), size)
    if every != before:
        save_tags(every, path)
    shown = [one for one in every if one.camera in (None, tagged.camera)]
    if arguments.picture is not None:
        seen = pictures.Seen(shown, proposals=proposals)
        title = f"{tagged.name}: {len(shown)} marks" + (f", {len(proposals)} proposals" if proposals else "")
        write_picture(arguments.picture, pictures.overlay(mean_picture(tagged), seen, title, grid=True))
    for number, one in enumerate(shown, 1):
        span = f" from {one.since:g} s" * (one.since > 0) + (f" until {one.until:g} s" if one.until is not None else "")
        _say(arguments, f"mark {number}: {one.kind} {one.label or ''} at {one.u:g},{one.v:g}{span}")
    for number, flash in enumerate(proposals, 1):
        _say(arguments, f"proposal {number}: {flash.u:.2f},{flash.v:.2f} score {flash.score:.3g}")
    return _done(
        arguments,
        {
            "file": str(path),
            "tags": [asdict(one) for one in shown],
            "proposals": [_flash(flash) for flash in proposals],
        },
    )


def run(arguments: argparse.Namespace) -> int:
    """Run a detector and say what it finds, and when."""
    results = []
    opened = _open_all(arguments)
    if arguments.picture is not None and len(opened) != 1:
        raise InputError(f"--picture draws one footage, here are {len(opened)}; name one, or its camera")
    for one in opened:
        detector = _detector(arguments, one)
        last, events, frames = None, [], 0
        known: list[Flash] = []
        for step in steps(one, detector, arguments.since, arguments.until):
            last, frames = step, frames + 1
            if step.decided:
                present = detector.flashes()
                events += appearances(known, present, step.shot.t, step.number)
                known = present
        seen = pictures.Seen(
            [tag for tag in one.tags if last is None or tag.share(arguments.since, last.shot.t) > 0], known
        )
        verdict = seen.verdict
        results.append(
            {
                "footage": one.name,
                "detector": arguments.detector,
                "settings": plain_settings(detector),
                "frames": frames,
                "flashes": [_flash(flash) for flash in known],
                "events": [
                    {"t": round(e.t, 4), "frame": e.frame, "appears": e.appears, **_flash(e.flash)} for e in events
                ],
                "missed": [asdict(seen.labels[k]) for k in verdict.missed],
                "false": [_flash(known[k]) for k in verdict.false],
            }
        )
        _say(arguments, f"{one.name}: {len(known)} flashes in {frames} frames")
        for flash in known:
            _say(arguments, f"    {flash.u:8.2f} {flash.v:8.2f} +-{flash.sigma:.3f} px  score {flash.score:.4g}")
        if arguments.picture is not None and last is not None:
            title = f"{one.name} at {last.shot.t:.2f} s, {arguments.detector}: {len(known)} flashes"
            write_picture(arguments.picture, pictures.overlay(last.shot.image, seen, title))
    return _done(arguments, {"results": results})


def show(arguments: argparse.Namespace) -> int:
    """Draw how a detector reacts to one frame, and the course of one place up to it."""
    tagged = _open(arguments)
    detector = _detector(arguments, tagged)
    trace = _trace(arguments, tagged)
    last = None
    for step in steps(tagged, detector, arguments.since):
        if arguments.at is not None and step.shot.t > arguments.at and last is not None:
            break
        last = step
        if trace is not None:
            trace.add_frame(step.shot.image, step.shot.t)
            if step.decided:
                trace.add_score(detector.explain(), step.shot.t)
        if arguments.frame is not None and step.number >= arguments.frame:
            break
    if last is None:
        raise InputError(f"{tagged.name}: has no frame from {arguments.since:g} s on")
    if arguments.at is not None and arguments.at > last.shot.t + _LATE_S:
        raise InputError(f"--at {arguments.at:g}: {tagged.name} ends at {last.shot.t:.2f} s")
    if arguments.frame is not None and arguments.frame > last.number:
        raise InputError(f"--frame {arguments.frame}: {tagged.name} has frames 0 to {last.number}")
    shot, explained, flashes = last.shot, detector.explain(), detector.flashes()
    tags = [tag for tag in tagged.tags if tag.share(arguments.since, max(shot.t, 1e-6)) > 0.0]
    seen = pictures.Seen(tags, flashes)
    title = f"{tagged.name}, frame {last.number}, {shot.t:.3f} s; {arguments.detector}: {len(flashes)} flashes"
    picture = pictures.reaction(shot.image, seen, explained, title)
    if trace is not None:
        if detector.knows_phase:
            trace.add_pattern(flashes, detector.settings.pattern)
        course = pictures.place(shot.image, seen, trace.since(shot.t - arguments.window), picture.shape[1])
        picture = np.vstack([picture, course])
    write_picture(arguments.output, picture)
    _say(arguments, f"{arguments.output}: {title}")
    result: dict[str, Any] = {
        "picture": str(arguments.output),
        "frame": last.number,
        "t": round(shot.t, 6),
        "settings": plain_settings(detector),
        "threshold": explained.threshold,
        "triggers": [asdict(trigger) for trigger in explained.triggers],
        "clusters": [asdict(cluster) for cluster in explained.clusters],
        "flashes": [_flash(flash) for flash in flashes],
    }
    if trace is not None:
        result["trace"] = asdict(trace.since(shot.t - arguments.window))
    return _done(arguments, result)


def compare(arguments: argparse.Namespace) -> int:
    """What a detector measures at marked labels, beside what it measures elsewhere."""
    opened = _open_all(arguments)
    _need_tags(opened, arguments)
    found = [
        item for one in opened for item in measure(one, _detector(arguments, one), arguments.since, arguments.until)
    ]
    if not found:
        raise InputError(f"the detector '{arguments.detector}' had no trigger in this footage")
    values = {
        name: ([i.values[name] for i in found if i.on_label], [i.values[name] for i in found if not i.on_label])
        for name in found[0].values
    }
    table = {
        name: {
            where: {f"{q}%": round(float(np.percentile(chosen, q)), 4) for q in QUANTILES} | {"n": len(chosen)}
            for where, chosen in (("on_labels", on_label), ("elsewhere", elsewhere))
            if chosen
        }
        for name, (on_label, elsewhere) in values.items()
    }
    for name, entry in table.items():
        for where, row in entry.items():
            _say(arguments, f"{name:>12} {where:>10}: " + "  ".join(f"{key} {value:g}" for key, value in row.items()))
    if arguments.picture is not None:
        write_picture(arguments.picture, pictures.histograms(values, (1000, 260)))
    return _done(arguments, {"detector": arguments.detector, "measured": table})


def score(arguments: argparse.Namespace) -> int:
    """Recall, precision, centroid error and spread over tagged footage."""
    scores = {cut: Score() for cut in sorted({*arguments.after, math.inf})}
    settings = read_settings(arguments.set, arguments.settings)
    opened = _open_all(arguments)
    _need_tags(opened, arguments)
    for one in opened:
        judge_clips(
            one,
            lambda one: make_detector(arguments.detector, settings, one.taken),
            scores,
            clip_s=arguments.clip,
            since=arguments.since,
            until=arguments.until,
        )
    tables = {("end" if math.isinf(cut) else f"{cut:g}"): total for cut, total in scores.items()}
    _say(
        arguments,
        f"{'after s':>8} {'clips':>6} {'labels':>7} {'recall %':>22} {'precision %':>22} {'rms px':>7} {'spread':>7}",
    )
    for name, total in tables.items():
        _say(arguments, _row(name, total))
        for text in total.missed if name == "end" else ():
            _say(arguments, f"    {text}")
    return _done(
        arguments,
        {
            "detector": arguments.detector,
            "settings": settings,
            "scores": {name: total.table() for name, total in tables.items()},
            "missed": tables["end"].missed,
        },
    )


def tune(arguments: argparse.Namespace) -> int:
    """Search settings on one set of footage, and judge them on another."""
    settings = read_settings(arguments.set, arguments.settings)
    ranges = [parse_range(text) for text in arguments.param]
    same = shared(arguments.footage, arguments.report)
    if same:
        names = ", ".join(map(str, same))
        raise InputError(
            f"--report {names}: is in the tuning set, too; a judgement needs footage that was not tuned on"
        )
    opened = _open_all(arguments)
    judges = open_all(arguments.report, camera=arguments.camera, fps=arguments.fps, channel=arguments.channel)
    _need_tags(judges, arguments)

    def tell(number: int, trial: Trial) -> None:
        tried = ", ".join(f"{one.name} = {trial.settings[one.name]}" for one in ranges if one.name in trial.settings)
        text = f"trial {number}: {trial.value:.4f}  {tried or 'as given'}"
        print(text, file=sys.stderr)

    trials = search(
        opened,
        arguments.detector,
        settings,
        ranges,
        trials=max(1, arguments.trials),
        seed=arguments.seed,
        clip_s=arguments.clip,
        min_precision=arguments.min_precision,
        tell=tell,
    )
    best = trials[0]
    given = next(trial for trial in trials if trial.settings == settings)
    result: dict[str, Any] = {
        "detector": arguments.detector,
        "settings": best.settings,
        "tuned_on": {
            "footage": [one.name for one in opened],
            "note": "figures of the set that was tuned on are too good",
            "before": given.score.table(),
            "after": best.score.table(),
        },
        "reported_on": None,
        "trials": [{"settings": trial.settings, "value": round(trial.value, 5)} for trial in trials],
    }
    _say(arguments, f"best settings: {best.settings or 'those given'}")
    _say(arguments, "on the tuning set (too good to be quoted):")
    _say(arguments, f"{_row('before', given.score)}\n{_row('after', best.score)}")
    if judges:
        before = score_set(judges, arguments.detector, settings, arguments.clip)
        after = score_set(judges, arguments.detector, best.settings, arguments.clip)
        result["reported_on"] = {
            "footage": [one.name for one in judges],
            "before": before.table(),
            "after": after.table(),
        }
        _say(arguments, f"on other footage:\n{_row('before', before)}\n{_row('after', after)}")
    else:
        _say(arguments, "how good they are elsewhere is not known; give other footage with --report")
    if arguments.output is not None:
        lines = [f"{k} = {toml(v)}" for k, v in best.settings.items()] or ["# no setting is better than those given"]
        write_atomic(arguments.output, ("\n".join(lines) + "\n").encode())
    return _done(arguments, result)


def export(arguments: argparse.Namespace) -> int:
    """Frames as pictures or as a recording."""
    tagged = _open(arguments)
    span = arguments.since, arguments.until
    if arguments.output.suffix.lower() == ".mcap":
        count = export_recording(tagged, arguments.output, span, arguments.every)
        written = [str(arguments.output)]
    else:
        files = export_frames(tagged, arguments.output, span, arguments.format, arguments.every, arguments.sharp)
        written, count = [str(path) for path in files], len(files)
    _say(arguments, f"{arguments.output}: {count} frames")
    return _done(arguments, {"output": str(arguments.output), "frames": count, "files": written})


def recover(arguments: argparse.Namespace) -> int:
    """Make a whole recording of one that was cut off."""
    contents = make_whole(arguments.footage, arguments.output)
    frames = ", ".join(f"{name} {count}" for name, count in contents.frames.items()) or "no"
    _say(arguments, f"{arguments.output}: {frames} frames, {contents.end - contents.begin:.2f} s")
    return _done(arguments, {"output": str(arguments.output), "frames": contents.frames})


# ---- small ones ------------------------------------------------------------------------------------------------------


def _open(arguments: argparse.Namespace) -> Tagged:
    return open_tagged(
        arguments.footage,
        camera=arguments.camera,
        fps=arguments.fps,
        times=arguments.times,
        channel=arguments.channel,
    )


def _open_all(arguments: argparse.Namespace) -> list[Tagged]:
    return open_all(
        arguments.footage,
        camera=arguments.camera,
        fps=arguments.fps,
        times=arguments.times,
        channel=arguments.channel,
    )


def _detector(arguments: argparse.Namespace, tagged: Tagged) -> Detector:
    return make_detector(arguments.detector, read_settings(arguments.set, arguments.settings), tagged.taken)


def _need_tags(opened: Sequence[Tagged], arguments: argparse.Namespace) -> None:
    without = [one for one in opened if not tags_path(one.footage.path).exists()]
    if without:
        raise InputError(
            *(
                f"{one.name}: has no marks ({tags_path(one.footage.path).name}); make them with robotd-solver workbench"
                " tag, also if there is no light: an empty file then says so"
                for one in without
            )
        )


def _proposals(arguments: argparse.Namespace, tagged: Tagged, tags: Sequence[Tag]) -> list[Flash]:
    """What a detector finds where no mark is, from top to bottom."""
    detector = _detector(arguments, tagged)
    for _ in steps(tagged, detector):
        pass
    mine = [tag for tag in tags if tag.camera in (None, tagged.camera)]
    free = [
        flash
        for flash in detector.flashes()
        if not any(math.hypot(tag.u - flash.u, tag.v - flash.v) < tag.radius for tag in mine)
    ]
    return sorted(free, key=lambda flash: (round(flash.v / 20.0), flash.u))


def _trace(arguments: argparse.Namespace, tagged: Tagged) -> Trace | None:
    if arguments.place is not None:
        return Trace(*arguments.place)
    if arguments.mark is None:
        return None
    if not 1 <= arguments.mark <= len(tagged.tags):
        raise InputError(f"no mark {arguments.mark}; there are {len(tagged.tags)}")
    chosen = tagged.tags[arguments.mark - 1]
    return Trace(chosen.u, chosen.v)


def _flash(flash: Flash) -> dict[str, Any]:
    return {
        "u": round(flash.u, 4),
        "v": round(flash.v, 4),
        "sigma": round(flash.sigma, 5),
        "score": round(flash.score, 4),
        "phase": round(flash.phase, 5),
        "amplitude": round(flash.amplitude, 2),
        "saturated": flash.saturated,
    }


def _row(name: str, total: Score) -> str:
    table = total.table()

    def share(value: float | None, limits: tuple[float, float]) -> str:
        return "-" if value is None else f"{100 * value:.1f} ({100 * limits[0]:.1f}-{100 * limits[1]:.1f})"

    recall = share(table["recall"], table["recall_range"])
    precision = share(table["precision"], table["precision_range"])
    rms, spread = ("-" if table[key] is None else f"{table[key]:.3f}" for key in ("rms_px", "spread_px"))
    return f"{name:>8} {total.clips:>6} {total.labels:>7} {recall:>22} {precision:>22} {rms:>7} {spread:>7}"


def _say(arguments: argparse.Namespace, text: str) -> None:
    if not arguments.json:
        print(text, flush=True)


def _done(arguments: argparse.Namespace, result: dict[str, Any]) -> int:
    if arguments.json:
        print(json.dumps(result, default=_plain))
    return 0


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(type(value).__name__)
