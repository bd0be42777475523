"""Tables and figures of a run."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.peers.measure import OURS, PANDA, SERVED, Score, limits, rival
from benchmarks.peers.scene import Cell

Scores = dict[Cell, dict[str, Score]]

_OWN = (OURS, SERVED)
_FIGURES = (("single snapshots", "peers.png"), ("60 s of data", "peers-minute.png"))
_NAMES = {"rural1-behind": "rural1, 13 customers", "rural3-behind": "rural3, 118 customers"}


def line(cell: Cell, scores: dict[str, Score]) -> str:
    """One cell in one line: exact / false in per cent, and the time."""
    parts = [
        f"{name} {_percent(s.exact, s)}/{_percent(s.false, s)} {s.ms:.2f} ms" for name, s in scores.items()
    ]
    return f"{cell.feeder} {cell.std_v:g} {cell.attack} {cell.liars}: " + " | ".join(parts)


def _percent(count: int, score: Score) -> str:
    return f"{100.0 * count / score.trials:.0f}" if score.trials else "-"


def _seen(score: Score) -> str:
    return _percent(score.seen, score) if score.seen >= 0 else ""


def tables(single: Scores, minute: Scores, *, drawn: bool = False) -> str:
    """Everything as Markdown; the figures, too, where they are drawn."""
    figures = (
        [f"![Exactly identified meters, {what}]({name})" for what, name in _FIGURES] if drawn else ["", ""]
    )
    parts = ["## Single snapshots", _exact(single), figures[0], _clean(single), _details(single)]
    if minute:
        parts += ["## With 60 s of data", _exact(minute), figures[1], _clean(minute)]
    parts = [part for part in parts if part]
    return "\n\n".join(parts) + "\n"


def _rows(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _place(cell: Cell) -> list[str]:
    return [
        _NAMES.get(cell.feeder, cell.feeder),
        f"{100 * cell.std_v:g} % V, {100 * cell.std_pq:g} % PQ",
        f"{cell.attack} {cell.liars}" if cell.liars else cell.attack,
    ]


def _exact(scores: Scores) -> str:
    names = list(next(iter(scores.values())))
    rows = []
    for cell, here in scores.items():
        if cell.attack == "clean":
            continue
        ours = here[OURS]
        row = [_percent(here[name].exact, here[name]) for name in names if name not in _OWN]
        own = f"**{_percent(ours.exact, ours)}**"
        rows.append(
            [
                *_place(cell),
                *row,
                own,
                _percent(ours.among, ours),
                _paired(here),
                *(
                    [_percent(here[SERVED].exact, here[SERVED]), _seen(here[PANDA])]
                    if SERVED in names
                    else []
                ),
            ]
        )
    head = [
        "feeder",
        "noise",
        "attack",
        *(n for n in names if n not in _OWN),
        "ours",
        "ours, among explanations",
        "ours - best peer (only ours : only the peer)",
        *([SERVED, "detected by the chi-square test"] if SERVED in names else []),
    ]
    return "Exactly the manipulated meters named, % of snapshots:\n\n" + _rows(head, rows)


def _paired(here: dict[str, Score]) -> str:
    """The least difference to a peer in snapshots that both saw, in per cent and in numbers of snapshots."""
    best = rival(here)
    if best is None:
        return ""
    only, other, shared = best
    return f"{100.0 * (only - other) / shared:+.1f} ({only} : {other})"


def _clean(scores: Scores) -> str:
    names = list(next(iter(scores.values())))
    rows = [
        [
            *_place(cell)[:2],
            *(f"{100.0 * s.false / s.trials:.1f}" if s.trials else "-" for s in here.values()),
            _limits(here[OURS]),
        ]
        for cell, here in scores.items()
        if cell.attack == "clean"
    ]
    return "At least one meter named without an attack, % of clean snapshots:\n\n" + _rows(
        ["feeder", "noise", *names, "ours, limits at 95 %"], rows
    )


def _limits(score: Score) -> str:
    return " to ".join(f"{100.0 * part:.1f}" for part in limits(score.false, score.trials))


def _details(scores: Scores) -> str:
    names = list(next(iter(scores.values())))
    rows = []
    for cell, here in scores.items():
        for name in names:
            s = here[name]
            if not s.trials:
                continue
            numbers = [_percent(count, s) for count in (s.exact, s.missed, s.false, s.failed)]
            rows.append([*_place(cell), name, str(s.trials), *numbers, _seen(s)])
    head = [
        "feeder",
        "noise",
        "attack",
        "method",
        "snapshots",
        "exact",
        "manipulated meter missed",
        "honest meter named",
        "no result",
        "detected by the chi-square test",
    ]
    return "All numbers, % of snapshots:\n\n" + _rows(head, rows)


def save(path: Path, single: Scores, minute: Scores) -> None:
    """Keep the numbers of a run."""
    kept = [
        [[asdict(cell), {name: asdict(s) for name, s in here.items()}] for cell, here in scores.items()]
        for scores in (single, minute)
    ]
    path.write_text(json.dumps(kept), encoding="utf-8")


def load(paths: list[Path]) -> tuple[Scores, Scores]:
    """The numbers of several runs together."""
    single: Scores = {}
    minute: Scores = {}
    for path in paths:
        for scores, kept in zip((single, minute), json.loads(path.read_text(encoding="utf-8")), strict=True):
            for cell, here in kept:
                scores[Cell(**cell)] = {name: Score(**numbers) for name, numbers in here.items()}
    return single, minute


def write(folder: Path, single: Scores, minute: Scores, speed: str) -> None:
    """Write peers.md and its figures."""
    text = (Path(__file__).parent / "text.md").read_text(encoding="utf-8")
    text = text.replace("{tables}", tables(single, minute, drawn=True)).replace("{speed}", speed.strip())
    (folder / "peers.md").write_text(text, encoding="utf-8")
    for (_, name), scores in zip(_FIGURES, (single, minute), strict=True):
        if scores:
            _draw(folder / name, scores)


def _draw(path: Path, scores: Scores) -> None:
    import matplotlib as mpl  # only where figures are wanted

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    attacked = [cell for cell in scores if cell.attack != "clean"]
    places = list(dict.fromkeys((cell.feeder, cell.std_v) for cell in attacked))
    names = list(next(iter(scores.values())))
    figure, axes = plt.subplots(len(places), 1, figsize=(9, 0.5 + 1.9 * len(places)), squeeze=False)
    for axis, place in zip(axes[:, 0], places, strict=True):
        here = [cell for cell in attacked if (cell.feeder, cell.std_v) == place]
        x, width = np.arange(len(here)), 0.8 / len(names)
        for k, name in enumerate(names):
            exact = [100.0 * scores[cell][name].exact / max(scores[cell][name].trials, 1) for cell in here]
            axis.bar(x + (k - (len(names) - 1) / 2) * width, exact, width, label=name)
        axis.set_ylabel("exact, %")
        axis.set_ylim(0, 100)
        axis.set_title(", ".join(_place(here[0])[:2]), fontsize=9)
        axis.set_xticks(x, [f"{cell.attack} {cell.liars}" for cell in here], fontsize=8)
        axis.set_axisbelow(True)
        axis.grid(axis="y", linewidth=0.4)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), ncols=len(names), fontsize=8, loc="upper center")
    figure.tight_layout(rect=(0, 0, 1, 0.96))
    figure.savefig(path, dpi=80)
    plt.close(figure)
