"""Evaluations side by side, as figures and a table.

OUT/report.md               the table, and the pairs that met the same scenes
OUT/force-TASK.png          contact force of each arm over time: mean and standard deviation over the trials
OUT/stiffness-TASK.png      one rollout of each agent: the stiffness it asks for against the force it feels
OUT/drawings.png            the mean drawing of each agent, with its likeness to the reference
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from controller.types import Array
from studio.catalog import Catalog
from studio.episode import Episode, open_episode
from studio.evaluation import Comparison, Evaluation, Rollout, compare, named, pooled, wilson
from studio.tasks import drawing

# Okabe and Ito's colours, told apart by everybody.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
FORCE, STIFFNESS = COLORS[0], COLORS[1]
SMOOTH = 25  # states of 500 Hz that a plotted force is averaged over: 0.05 s
DPI = 110
OpenEpisode = Callable[[str], Episode]


def write(evaluations: Sequence[Evaluation], open_episode: OpenEpisode, out: Path) -> list[Path]:
    """Draw and tabulate; the paths of what was written. `open_episode` finds a rollout by its id."""
    if not evaluations:
        raise ValueError("A report needs at least one evaluation.")
    out.mkdir(parents=True, exist_ok=True)
    figures = {}
    for task in dict.fromkeys(evaluation.task for evaluation in evaluations):
        of_task = [evaluation for evaluation in evaluations if evaluation.task == task]
        figures[f"force-{task}.png"] = force_figure(of_task)
        figures[f"stiffness-{task}.png"] = stiffness_figure(of_task, open_episode)
        if task == drawing.Task.name:
            figures["drawings.png"] = drawings_figure(of_task, open_episode)
    for name, figure in figures.items():
        figure.savefig(out / name, dpi=DPI)
    (out / "report.md").write_text(_text(evaluations))
    return [out / "report.md", *(out / name for name in figures)]


def picture(data_dir: Path, evaluation_ids: Sequence[str], figure: Literal["force", "stiffness"]) -> bytes:
    """A figure of evaluations of one task by their ids, as PNG. Raises KeyError for unknown ones."""
    found = [named(data_dir, evaluation_id) for evaluation_id in evaluation_ids]
    if not found or len({evaluation.task for evaluation in found}) > 1:
        raise ValueError("A figure shows evaluations of one task.")
    if figure == "force":
        drawn = force_figure(found)
    else:
        with closing(Catalog(data_dir)) as catalog:
            drawn = stiffness_figure(found, lambda name: open_episode(catalog.get(name).path))
    file = io.BytesIO()
    drawn.savefig(file, dpi=DPI, format="png")
    return file.getvalue()


# Tables


def table(evaluations: Sequence[Evaluation]) -> str:
    """One row each, as Markdown."""
    rows = [
        (
            "task",
            "agent",
            "success",
            "95 %",
            "force N",
            "peak N",
            "mean peak N",
            "impulse N·s",
            "seconds",
            "errors",
        ),
        ("---", "---", *["---:"] * 8),
    ]
    for evaluation in evaluations:
        told = evaluation.summary()
        low, high = wilson(told["successes"], told["episodes"])
        rows.append(
            (
                evaluation.task,
                evaluation.label,
                f"{told['successes']}/{told['episodes']}",
                f"{low:.0%}–{high:.0%}",
                f"{told['force_mean_N']:.1f} ± {told['force_sd_N']:.1f}",
                f"{told['force_max_N']:.1f}",
                f"{told['force_peak_mean_N']:.1f}",
                f"{told['impulse_mean_Ns']:.1f}",
                f"{told['seconds_per_episode']:.1f}",
                str(len(told["errors"])),
            )
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def pairs(evaluations: Sequence[Evaluation]) -> list[str]:
    """A sentence for every two that met the same scenes, and for what hiding does to all runs together.

    Whoever sees and feels all comes first, in whatever order they are given.
    """
    ordered = sorted(evaluations, key=lambda evaluation: bool(evaluation.provenance.get("hidden")))
    met = [(*two, compare(*two)) for two in itertools.combinations(ordered, 2) if _meet(*two)]
    told = [str(comparison) for _, _, comparison in met]
    blinded: dict[tuple[str, ...], list[Comparison]] = {}
    for one, other, comparison in met:
        if hidden := _only_blinded(one, other):
            blinded.setdefault((one.task, *hidden), []).append(comparison)
    for (_, *blind), same in blinded.items():
        if len(same) > 1:
            words = f"the same with {' and '.join(blind)} hidden"
            told.append(str(pooled(same, f"{len(same)} runs that see and feel all", words)))
    return told


def _meet(one: Evaluation, other: Evaluation) -> bool:
    """Whether they share scenes."""
    same = (one.task, one.spread) == (other.task, other.spread)
    return same and bool({r.seed for r in one.judged} & {r.seed for r in other.judged})


def _only_blinded(one: Evaluation, other: Evaluation) -> tuple[str, ...]:
    """What is hidden in the second of two evaluations that are otherwise of the same policy."""
    keys = ("run", "step", "execution", "replan_every")
    if one.provenance.get("hidden") or [one.provenance.get(k) for k in keys] != [
        other.provenance.get(k) for k in keys
    ]:
        return ()
    return tuple(other.provenance.get("hidden", ()))


def _text(evaluations: Sequence[Evaluation]) -> str:
    sources = [f"- {e.label} on {e.task}: {e.evaluation_id}, seeds {_seeds(e)}" for e in evaluations]
    paired = [f"- {sentence}" for sentence in pairs(evaluations)]
    parts = [
        "# Report",
        table(evaluations),
        "Force: mean ± standard deviation over the time in contact, of the arm that feels the most.",
        "## On the same scenes\n\n" + "\n".join(paired) if paired else "",
        "## Evaluations\n\n" + "\n".join(sources),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _seeds(evaluation: Evaluation) -> str:
    seeds = [rollout.seed for rollout in evaluation.rollouts]
    if seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}:{seeds[-1] + 1}"
    return ",".join(map(str, seeds))


# Figures


def force_figure(evaluations: Sequence[Evaluation]) -> Figure:
    """The paper's force figure: a panel for each arm, a line with its band for each agent."""
    arms = list(evaluations[0].curves)
    figure, panels = _panels(len(arms), 1, height=3.2)
    for arm, panel in zip(arms, panels, strict=True):
        for evaluation, color in zip(evaluations, itertools.cycle(COLORS)):
            curves = evaluation.curves[arm]
            n = sum(trials >= len(evaluation.judged) / 2 for trials in curves.trials)
            time, mean, sd = np.array((curves.time_s, curves.force_mean_N, curves.force_sd_N))[:, :n]
            panel.plot(time, mean, color=color, label=evaluation.label)
            low = np.maximum(mean - sd, 0.0)
            panel.fill_between(time, low, mean + sd, color=color, alpha=0.2, linewidth=0)
        panel.set(ylabel=f"Force, {arm} arm [N]", xlim=(0, None), ylim=(0, None))
        panel.grid(alpha=0.3)
    panels[0].legend(frameon=False, fontsize="small", ncols=2)
    panels[0].set_title(f"{evaluations[0].task}: mean ± standard deviation, while half of the trials run")
    panels[-1].set_xlabel("Time [s]")
    return figure


def stiffness_figure(evaluations: Sequence[Evaluation], open_episode: OpenEpisode) -> Figure:
    """Of each agent its first success, else its first rollout: a panel for each arm."""
    shown = [(e, r) for e in evaluations if (r := _typical(e)) is not None]
    arms = list(evaluations[0].curves)
    figure, panels = _panels(max(1, len(shown)), len(arms), height=1.9)
    for number, (evaluation, rollout) in enumerate(shown):
        with open_episode(rollout.episode_id) as episode:
            columns = episode.columns(*(f"{arm}/{what}" for arm in arms for what in ("state", "requested")))
        for place, arm in enumerate(arms):
            panel = panels[number * len(arms) + place]
            _against(
                panel, {k.removeprefix(f"{arm}/"): c for k, c in columns.items() if k.startswith(f"{arm}/")}
            )
            panel.set_title(f"{evaluation.label}, seed {rollout.seed}, {arm} arm", fontsize="small")
    for panel in panels[-len(arms) :]:
        panel.set_xlabel("Time [s]")
    return figure


def drawings_figure(evaluations: Sequence[Evaluation], open_episode: OpenEpisode) -> Figure:
    """The reference and the mean drawing of each agent."""
    figure, panels = _panels(1, len(evaluations) + 1, height=3.0, width=2.6)
    _show(panels[0], drawing.reference().grid, "reference")
    for evaluation, panel in zip(evaluations, panels[1:], strict=True):
        grids = []
        for rollout in evaluation.judged:
            with open_episode(rollout.episode_id) as episode:
                grids.append(episode.task_state_at(episode.duration)["ink"].astype(float))
        if grids:
            alike = [drawing.likeness(grid) for grid in grids]
            words = f"SSIM {np.mean(alike):.3f} ± {np.std(alike):.3f}, n = {len(grids)}"
            _show(panel, np.mean(grids, axis=0), f"{evaluation.label}\n{words}")
    return figure


def _panels(rows: int, columns: int, height: float, width: float | None = None) -> tuple[Figure, list[Axes]]:
    size = ((width or 7.0 / max(1, columns - 1)) * columns, height * rows)
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False)))


def _typical(evaluation: Evaluation) -> Rollout | None:
    judged = evaluation.judged
    return next((rollout for rollout in judged if rollout.success), judged[0] if judged else None)


def _against(panel: Axes, columns: Mapping[str, Array]) -> None:
    """Force on the left axis, the requested stiffness on the right one."""
    force = np.linalg.norm(columns["state/wrench"][:, :3], axis=1)
    smooth = np.convolve(force, np.full(SMOOTH, 1 / SMOOTH), mode="same")
    panel.plot(columns["state/time"], smooth, color=FORCE, linewidth=0.9)
    panel.set_ylabel("Force [N]", color=FORCE)
    panel.set(xlim=(0, None), ylim=(0, None))
    stiff = panel.twinx()
    mean = columns["requested/stiffness"][:, [0, 3, 5]].mean(axis=1)  # xx, yy, zz of the translational block
    stiff.plot(columns["requested/time"], mean, color=STIFFNESS, linewidth=1.2)
    stiff.set_ylabel("Stiffness [N/m]", color=STIFFNESS)
    stiff.set_ylim(0, 1000)


def _show(panel: Axes, grid: Array, words: str) -> None:
    panel.imshow(grid, cmap="gray_r", vmin=0, vmax=255)
    panel.set_title(words, fontsize="small")
    panel.set(xticks=[], yticks=[])
