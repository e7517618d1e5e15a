"""What the view of a take asks for over HTTP: its timeline and curves, takes together, films."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import http_site
import httpx
import numpy as np
import pytest

from studio import curves
from studio.client import Client, Refused
from studio.cursor import Cursor


class Site(http_site.Site):
    """With two takes, of two arms and three cameras."""

    def __init__(self, data: Path) -> None:
        http_site.record(data, 1.0, 1.5)
        super().__init__(data)
        self.short, self.long = (
            row.episode_id for row in self.studio.catalog.episodes(sort="duration", descending=False)
        )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("view"))
    yield site
    site.close()


def test_the_timeline_is_the_cursors(site: Site, client: Client) -> None:
    told = client.timeline(site.long)
    with site.studio.open(site.long) as episode:
        cursor = Cursor(episode)
        assert told.duration == cursor.duration
        assert told.marks == cursor.marks
        assert [(arm.name, arm.phases, arm.modes) for arm in told.arms] == [
            (arm.name, arm.phases, arm.modes) for arm in cursor.arms
        ]
        assert told.images["front"] == pytest.approx(episode.image_times("front").tolist())
    touched = [span.start for arm in told.arms for span in arm.phases if span.label == "contact"]
    assert told.first_contact == min(touched)


def test_curves_are_those_of_the_columns(site: Site, client: Client) -> None:
    found = client.curves(site.long, "right/force_z", "right/torque", "left/stiffness", points=5000)
    columns = client.columns(site.long, "right/state", "left/applied")
    wrench = columns["right/state/wrench"]
    assert found.is_exact
    assert found.time == pytest.approx(columns["right/state/time"].tolist(), abs=1e-4)
    assert found.curves["right/force_z"] == pytest.approx(wrench[:, 2].tolist(), abs=1e-3)
    assert found.curves["right/torque"] == pytest.approx(
        np.linalg.norm(wrench[:, 3:], axis=1).tolist(), abs=1e-3
    )
    stiffness = columns["left/applied/stiffness"][:, [0, 3, 5]].mean(axis=1)
    assert found.curves["left/stiffness"][0] == pytest.approx(stiffness[0], abs=1e-3)
    assert found.units == {"right/force_z": "N", "right/torque": "N·m", "left/stiffness": "N/m"}
    part = client.curves(site.long, start=0.5, end=0.6)
    assert part.time[0] == pytest.approx(0.5, abs=0.003)
    assert part.time[-1] == pytest.approx(0.6, abs=0.003)
    assert len(part.curves) == 2 * len(curves.UNITS)


def test_thinning_loses_no_peak_and_invents_nothing() -> None:
    rng = np.random.default_rng(0)
    time, values = np.arange(10_007) * 0.002, rng.normal(size=(3, 10_007))
    values[0, 4321], values[1, 5000:6000] = 99.0, np.nan
    thin_time, thin = curves.thinned(time, values, 500)
    assert len(thin_time) <= 2 * 500 + 2
    assert (np.diff(thin_time) > 0).all()
    for kept, whole in zip(thin, values, strict=True):
        assert np.nanmin(kept) == np.nanmin(whole)
        assert np.nanmax(kept) == np.nanmax(whole)
        assert np.isin(kept[np.isfinite(kept)], whole).all()
    peak = thin_time[thin[0].argmax()]
    assert abs(peak - time[4321]) < 0.002 * 21  # one stretch
    assert np.isnan(thin[1][(thin_time > 10.1) & (thin_time < 11.9)]).all()


def test_takes_together_have_the_mean_and_spread_of_each(site: Site, client: Client) -> None:
    alone = [client.spread(each).mean["left/force"] for each in (site.short, site.long)]
    both = client.spread(site.short, site.long)
    n = len(alone[0])
    assert both.count == [2] * n + [1] * (len(alone[1]) - n)
    expected = np.array([alone[0], alone[1][:n]], float)
    assert both.mean["left/force"][:n] == pytest.approx(expected.mean(axis=0).tolist(), abs=2e-3)
    assert both.sd["left/force"][:n] == pytest.approx(expected.std(axis=0, ddof=1).tolist(), abs=2e-3)
    assert both.mean["left/force"][n:] == alone[1][n:]
    assert set(both.sd["left/force"][n:]) == {0.0}
    at_contact = client.spread(site.short, site.long, align="contact")
    assert at_contact.time[0] == pytest.approx(-client.timeline(site.short).first_contact, abs=0.051)


def test_an_arrow_table_holds_a_group(site: Site, client: Client) -> None:
    table = client.table(site.short, "left/state")
    columns = client.columns(site.short, "left/state")
    assert table.column_names == list(columns)
    wrench = np.array(table["left/state/wrench"].to_pylist())
    assert np.array_equal(wrench, columns["left/state/wrench"])
    with pytest.raises(Refused, match="rows of one length") as refused:
        client.table(site.short, "left/state", "tick")
    assert refused.value.status == 422


def test_a_film_shows_each_image_at_its_time_and_comes_in_parts(
    site: Site, client: Client, tmp_path: Path
) -> None:
    film = client.video(site.short, "left_wrist")
    (tmp_path / "film.mp4").write_bytes(film)
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, float(stream.average_rate)) == ("h264", 20.0)
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    with site.studio.open(site.short) as episode:
        assert len(pictures) == round(episode.duration * 20) + 1
        for number in (0, 7, len(pictures) - 1):
            shown = episode.image_at("left_wrist", number / 20 + 1e-6)
            assert np.abs(pictures[number].astype(int) - shown).mean() < 6
    address = f"{site.front.url}/api/v1/episodes/{site.short}/video/left_wrist.mp4"
    part = httpx.get(address, headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, film[100:200])
    kept = site.studio.data_dir / "cache" / "video" / f"{site.short}.left_wrist.mp4"
    before = kept.stat().st_ino
    assert client.video(site.short, "left_wrist") == film
    assert kept.stat().st_ino == before


def test_what_there_is_not_is_said(site: Site, client: Client) -> None:
    cases = [
        (lambda: client.timeline("nothing"), 404, "No episode 'nothing'"),
        (lambda: client.curves(site.short, "middle/force"), 404, "No curve 'middle/force'"),
        (lambda: client.curves(site.short, start=3.0), 422, "nothing from 3.00"),
        (lambda: client.video(site.short, "back"), 404, "No camera 'back'"),
        (lambda: client.spread("nothing"), 404, "No episode 'nothing'"),
        (lambda: client._ask("PUT", "/view", body={"view": "x"}), 404, "no 3-D view"),
    ]
    for act, status, why in cases:
        with pytest.raises(Refused) as refused:
            act()
        assert refused.value.status == status
        assert why in str(refused.value)
