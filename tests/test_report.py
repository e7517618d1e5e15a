"""Reports: figures that show something, tables that say what the evaluations say."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from studio import report
from studio.api import Studio
from studio.evaluate import Plan
from studio.evaluation import Evaluation
from studio.tasks import drawing


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Evaluation]]:
    data = tmp_path_factory.mktemp("drawn")
    with Studio(data) as studio:
        agents = ("demonstrator", "all-high")
        return data, [studio.evaluate(Plan(agent=a, task="drawing", seeds=(1000,))) for a in agents]


def test_a_report_is_a_table_and_figures(drawn: tuple[Path, list[Evaluation]], tmp_path: Path) -> None:
    data, evaluations = drawn
    with Studio(data) as studio:
        files = report.write(evaluations, studio.open, tmp_path)
    names = ["report.md", "force-drawing.png", "stiffness-drawing.png", "drawings.png"]
    assert [path.name for path in files] == names
    for path in files[1:]:
        picture = cv2.imread(str(path))
        assert picture.shape[1] > 400
        assert 2.0 < picture.std() < 100.0  # neither blank nor noise
    text = files[0].read_text()
    for evaluation in evaluations:
        told = evaluation.summary()
        assert f"| {told['successes']}/1 |" in text
        assert (
            f"| {told['force_mean_N']:.1f} ± {told['force_sd_N']:.1f} | {told['force_max_N']:.1f} |" in text
        )
        assert evaluation.evaluation_id in text
    assert "demonstrator against all-high on 1 scenes of drawing" in text


def test_the_mean_drawing_is_that_of_the_episodes(drawn: tuple[Path, list[Evaluation]]) -> None:
    data, (demonstrator, _) = drawn
    with Studio(data) as studio:
        figure = report.drawings_figure([demonstrator], studio.open)
    shown = [np.asarray(panel.get_images()[0].get_array()) for panel in figure.axes]
    np.testing.assert_array_equal(shown[0], drawing.reference().grid)
    assert drawing.likeness(shown[1]) == pytest.approx(demonstrator.rollouts[0].progress)


def test_stiffness_is_low_where_the_demonstrator_presses(drawn: tuple[Path, list[Evaluation]]) -> None:
    data, (demonstrator, stiff) = drawn
    with Studio(data) as studio:
        figure = report.stiffness_figure([demonstrator, stiff], studio.open)
    lines = [panel.get_lines()[0].get_data() for panel in figure.axes]
    (times, forces), _, (when, stiffness), (_, high) = lines
    pressing = np.interp(when, times, forces) > 1.5
    assert pressing.sum() > 100
    assert np.median(stiffness[pressing]) == 250.0
    assert set(high) == {750.0}


def test_what_was_hidden_is_told(drawn: tuple[Path, list[Evaluation]]) -> None:
    seen = drawn[1][0]
    assert seen.label == "demonstrator"
    told = {"run": "wipe-1", "execution": "ensemble", "hidden": ["images"]}
    hidden = dataclasses.replace(seen, run="wipe-1", provenance=told)
    assert hidden.label == "wipe-1 (images hidden, ensemble)"
    other_task = dataclasses.replace(seen, task="wiping")
    assert len(report.pairs([seen, hidden, other_task])) == 1


def test_hiding_is_judged_over_all_runs(drawn: tuple[Path, list[Evaluation]]) -> None:
    """Each run sees in all of four scenes and fails blind: p = 1/8 each, 1/128 together."""
    (rollout,) = drawn[1][0].rollouts
    evaluations = []
    for run in ("one", "two"):
        for hidden in ([], ["objects"]):
            rollouts = tuple(dataclasses.replace(rollout, seed=n, success=not hidden) for n in range(4))
            told = {"run": run, "step": 9, "execution": "replan", "replan_every": 10, "hidden": hidden}
            evaluations.append(dataclasses.replace(drawn[1][0], run=run, provenance=told, rollouts=rollouts))
    sentences = report.pairs(evaluations)
    assert sentences[-1] == report.pairs(evaluations[::-1])[-1]
    assert len(sentences) == 6 + 1
    assert sum("p = 0.12)" in sentence for sentence in sentences) >= 2
    assert sentences[-1].startswith("2 runs that see and feel all against the same with objects hidden on 8")
    assert "(8 : 0 where only one succeeded, exact McNemar p = 0.0078)" in sentences[-1]


def test_a_report_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        report.write([], lambda episode_id: pytest.fail(episode_id), tmp_path)
