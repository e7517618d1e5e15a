"""The headless Python API. The page, the HTTP API and the command line are skins of this one class."""

from __future__ import annotations

import getpass
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Unpack

from controller.servo import ServoConfig
from controller.stiffness import StiffnessTable
from policy.config import TrainConfig
from studio import collections, survey, tasks, training
from studio import export as exports
from studio import replay as replays
from studio.catalog import Catalog, Refreshed
from studio.collections import Change, Collection
from studio.episode import Episode, open_episode
from studio.evaluate import Plan, evaluate
from studio.evaluation import Evaluation, Rollout, find, load_all
from studio.export import imports
from studio.health import TakeHealth
from studio.index import EpisodeRow, Filters
from studio.inputs.scripted import ScriptedAgent
from studio.jobs import plans
from studio.jobs.plans import Request
from studio.jobs.queue import JobNow, Jobs
from studio.pilot import Tried, runs_of, ways_to_play
from studio.recovery import Recovery, recover_all
from studio.session import Agent
from studio.station import Station, Take
from studio.twin import Twin

if TYPE_CHECKING:
    from policy.train import TrainResult


@dataclass(frozen=True, slots=True)
class DemoReport:
    """What `Studio.demo` recorded."""

    task: str
    episodes: int
    successes: int
    seeds: list[int]
    mean_force_N: float  # over the ticks in which the arm felt more than 1 N
    max_force_N: float
    ids: list[str]
    simulated_seconds: float
    failures: list[dict[str, Any]]  # seed, id, phase and progress of each take without success
    limits: dict[str, int]  # in how many takes each kind of limit acted
    errors: list[str]  # why recording of a take stopped early; the take was kept
    images: str  # "yes", "no", or why there are none although asked for


class Studio:
    """One data folder and everything that can be done with it. Close it, or use it in a `with`."""

    def __init__(self, data: str | Path = "data") -> None:
        self.data_dir = Path(data).absolute()
        self.catalog = Catalog(self.data_dir)
        self.jobs = Jobs(self.data_dir)

    def __enter__(self) -> Studio:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self.catalog.close()

    # Recording

    def demo(
        self,
        task: str,
        episodes: int = 1,
        seed: int = 0,
        *,
        cameras: bool = True,
        workers: int = 1,
        spread: float = 1.0,
        stiffness_table: StiffnessTable = "tuned",
        on_take: Callable[[Take], None] | None = None,
    ) -> DemoReport:
        """Record scripted demonstrations of seeds `seed` .. `seed + episodes - 1`.

        `stiffness_table` says what the stiffness modes mean.
        More than one worker means processes: a script that calls this needs the usual
        `if __name__ == "__main__"`.
        """
        if episodes < 1 or workers < 1:
            raise ValueError(f"Episodes and workers must be at least 1, not {episodes} and {workers}.")
        tasks.load(task)  # an unknown task is refused before anything starts
        seeds = list(range(seed, seed + episodes))
        config = ServoConfig.for_table(stiffness_table)
        takes: list[Take] = []
        images = "yes" if cameras else "no"
        for batch, camera_error in self._demonstrations(task, seeds, cameras, workers, spread, config):
            images = camera_error or images
            for take in batch:
                self.catalog.add(take.path)
                takes.append(take)
                if on_take:
                    on_take(take)
        return _report(task, sorted(takes, key=lambda take: take.seed), images)

    def record(
        self,
        task: str,
        make_agent: Callable[[Twin], Agent],
        *,
        agent_name: str = "script",
        seed: int = 0,
        spread: float = 1.0,
        cameras: bool = True,
        operator: str | None = None,
    ) -> EpisodeRow:
        """Record one take of any agent; `make_agent` is given the twin that it will drive."""
        with Station(task, self.data_dir, cameras=cameras) as station:
            take = station.record(
                make_agent, agent_name=agent_name, seed=seed, spread=spread, operator=operator
            )
        return self.catalog.add(take.path)

    def begin_run(
        self,
        task: str,
        config: TrainConfig,
        name: str | None = None,
        episodes: int | None = None,
        filters: Filters | None = None,
        collection: str | None = None,
    ) -> training.Run:
        """A run that learns a task from successful demonstrations, or from those that `filters` ask for.

        A `collection` tells which takes instead.
        """
        tasks.load(task)
        return training.prepare(
            self.catalog,
            task,
            config,
            name=name,
            episodes=episodes,
            filters=filters,
            collection=collection,
        )

    def run(self, name: str) -> training.Run:
        """One that was begun, to go on with."""
        return training.reopen(self.catalog, name)

    def train(
        self,
        run: training.Run,
        *,
        on_take: Callable[[str], None] = lambda name: None,
        on_step: Callable[[Mapping[str, float]], None] = lambda metrics: None,
    ) -> TrainResult:
        """Read the takes of a run, then let it learn until it is finished, or SIGTERM or SIGINT comes."""
        training.check_device(run)
        dataset = training.dataset_of(self.catalog, run, on_take)
        return training.train(run, dataset, on_step=on_step)

    def evaluate(
        self, plan: Plan, *, workers: int = 1, on_rollout: Callable[[Rollout], None] = lambda rollout: None
    ) -> Evaluation:
        """Roll out an agent over many seeds; every rollout is an episode, the evaluation a file beside them.

        More than one worker means processes, as for `demo`.
        """

        def index(rollout: Rollout, path: Path | None) -> None:
            if path is not None:
                self.catalog.add(path)
            on_rollout(rollout)

        evaluation = evaluate(plan, self.data_dir, workers=workers, on_rollout=index)
        self.catalog.refresh()  # also what a failed rollout has left
        return evaluation

    def runs_of(self, task: str) -> list[str]:
        """Names of the runs that have learned a task, the newest first."""
        return runs_of(task, self.data_dir)

    def ways_to_play(self, run: str) -> list[Tried]:
        """How a run's chunks may be played live, what did best in evaluations first."""
        return ways_to_play(run, self.data_dir)

    def evaluation(self, name: str, task: str | None = None) -> Evaluation:
        """By path, by id, or the newest of an agent."""
        return find(self.data_dir, name, task)

    def evaluations(self) -> list[Evaluation]:
        """The newest first."""
        return load_all(self.data_dir)

    def submit(self, request: Request) -> JobNow:
        """Put a job into the queue; `studio.jobs.plans` makes requests, `jobs` tells what becomes of them."""
        return plans.submit(self.jobs, request)

    # Takes

    def episodes(self, **filters: Unpack[Filters]) -> list[EpisodeRow]:
        """All takes that match, newest first; takes that others recorded meanwhile are found."""
        self.catalog.refresh()
        return self.catalog.episodes(limit=None, **filters)

    def open(self, episode_id: str) -> Episode:
        return open_episode(self.catalog.get(episode_id).path)

    def annotate(self, episode_id: str, *, author: str | None = None, **changes: Any) -> EpisodeRow:
        """Append an edit: outcome, quality, note, trim, add_flags, remove_flags, put_segments …"""
        return self.catalog.annotate(episode_id, author=author or getpass.getuser(), **changes)

    def annotate_all(
        self, episode_ids: Sequence[str], *, author: str | None = None, **changes: Any
    ) -> list[EpisodeRow]:
        """The same edit to several takes, or to none."""
        return self.catalog.annotate_all(episode_ids, author=author or getpass.getuser(), **changes)

    def delete(self, episode_id: str, *, even_if_used: bool = False) -> EpisodeRow:
        """Move a take to the trash; one in a collection only `even_if_used`."""
        return self.catalog.delete(episode_id, even_if_used=even_if_used)

    def restore(self, episode_id: str) -> EpisodeRow:
        """Bring a take back from the trash."""
        return self.catalog.restore(episode_id)

    # Collections

    def make_collection(
        self,
        name: str,
        *,
        episode_ids: Sequence[str] | None = None,
        filters: Filters | None = None,
        author: str | None = None,
        note: str = "",
    ) -> Collection:
        """Name some takes, or all that match, as they are now."""
        author = author or getpass.getuser()
        return collections.create(
            self.catalog, name, author=author, episode_ids=episode_ids, filters=filters, note=note
        )

    def collections(self) -> list[Collection]:
        """The newest first."""
        return collections.load_all(self.data_dir)

    def collection(self, name: str) -> Collection:
        return collections.load(self.data_dir, name)

    def collection_rows(self, name: str) -> list[EpisodeRow]:
        """The takes of a collection, as they were annotated when it was made."""
        return collections.rows_of(self.catalog, self.collection(name))

    def collection_changes(self, name: str) -> list[Change]:
        """What became of them since."""
        return collections.changes(self.catalog, self.collection(name))

    def delete_collection(self, name: str) -> None:
        """Move a collection to the trash; its takes stay."""
        collections.delete(self.data_dir, name)

    def restore_collection(self, name: str) -> Collection:
        """Bring it back."""
        return collections.restore(self.data_dir, name)

    # Looking closer

    def health(
        self,
        takes: Sequence[EpisodeRow] | None = None,
        *,
        on_take: Callable[[TakeHealth], None] = lambda health: None,
    ) -> survey.DatasetHealth:
        """What is wrong with some takes, or with all, and with them together; leaves none out.

        A take that is examined for the first time is read whole.
        """
        found = []
        for row in self.episodes() if takes is None else takes:
            told = survey.examine(self.data_dir, row)
            found.append((row, told))
            on_take(told)
        return survey.survey(found)

    def export(
        self,
        episode_ids: Sequence[str],
        out: str | Path,
        form: exports.Format,
        options: exports.Options | None = None,
        *,
        versions: Mapping[str, int] | None = None,
        on_progress: Callable[[float, str], None] = lambda share, what: None,
        cancel: threading.Event | None = None,
    ) -> exports.Exported:
        """Write takes for other programs to a new folder, all or nothing.

        They go as they are annotated now, or as `versions` of their edits told them, by id.
        `on_progress` hears the share done and the take in work; setting `cancel` ends it.
        """
        takes = exports.choose(self.catalog, episode_ids, versions)
        return exports.export(takes, form, Path(out), options, on_progress, cancel)

    def import_takes(
        self,
        source: str | Path,
        *,
        task: str | None = None,
        arms: Sequence[str] = (),
        rate: float | None = None,
        on_progress: Callable[[float, str], None] = lambda share, what: None,
        cancel: threading.Event | None = None,
    ) -> imports.Imported:
        """Bring in takes of another data folder, a LeRobot v3 dataset, or ACT's HDF5 files.

        `task` names what a dataset's takes show, `arms` and `rate` [Hz] are needed where it does not tell.
        """
        return imports.import_takes(
            self.catalog, Path(source), task=task, arms=arms, rate=rate, tell=on_progress, cancel=cancel
        )

    def replay(self, episode_id: str) -> replays.Replay:
        """Simulate a take again and compare it tick by tick."""
        with self.open(episode_id) as episode:
            return replays.replay(episode)

    def recover(self) -> list[Recovery]:
        """Make takes of the files that a crash left behind; takes being recorded are left alone."""
        recovered = recover_all(self.data_dir)
        self.catalog.refresh()
        return recovered

    def rebuild(self) -> Refreshed:
        """Read every take again into a fresh index."""
        return self.catalog.rebuild()

    def _demonstrations(
        self,
        task: str,
        seeds: list[int],
        cameras: bool,
        workers: int,
        spread: float,
        config: ServoConfig,
    ) -> Iterator[tuple[Sequence[Take], str | None]]:
        if workers == 1:
            with Station(task, self.data_dir, cameras=cameras, config=config) as station:
                for seed in seeds:
                    yield [_demonstrate(station, seed, spread)], station.camera_error
            return
        with ProcessPoolExecutor(
            workers, get_context("spawn"), _open_station, (task, self.data_dir, cameras, config)
        ) as pool:
            for done in as_completed([pool.submit(_demonstrate_here, seed, spread) for seed in seeds]):
                take, camera_error = done.result()
                yield [take], camera_error


_station: Station  # of a worker process


def _open_station(task: str, data_dir: Path, cameras: bool, config: ServoConfig) -> None:
    global _station
    _station = Station(task, data_dir, cameras=cameras, config=config)


def _demonstrate_here(seed: int, spread: float) -> tuple[Take, str | None]:
    return _demonstrate(_station, seed, spread), _station.camera_error


def _demonstrate(station: Station, seed: int, spread: float) -> Take:
    return station.record(
        lambda twin: ScriptedAgent(twin, seed),
        agent_name="scripted",
        operator="scripted",
        seed=seed,
        spread=spread,
    )


def _report(task: str, takes: list[Take], images: str) -> DemoReport:
    ticks = sum(take.contact_ticks for take in takes)
    kinds = sorted({kind for take in takes for kind in take.limits})
    return DemoReport(
        task=task,
        episodes=len(takes),
        successes=sum(take.ending.progress.success for take in takes),
        seeds=[take.seed for take in takes],
        mean_force_N=round(sum(take.contact_force_sum for take in takes) / max(ticks, 1), 4),
        max_force_N=round(max(take.peak_force for take in takes), 4),
        ids=[take.episode_id for take in takes],
        simulated_seconds=round(sum(take.ending.seconds for take in takes), 3),
        failures=[
            {
                "seed": take.seed,
                "id": take.episode_id,
                "phase": take.ending.progress.phase,
                "progress": round(take.ending.progress.value, 4),
            }
            for take in takes
            if not take.ending.progress.success
        ],
        limits={kind: sum(kind in take.limits for take in takes) for kind in kinds},
        errors=[f"{take.episode_id}: {take.error}" for take in takes if take.error],
        images=images,
    )
