"""A policy as an operator: asked in time, played tick by tick, here or behind a WebSocket."""

from __future__ import annotations

import dataclasses
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import blank
import msgspec
import numpy as np
import pytest
import websockets.sync.client
import websockets.sync.server
from agents import Listener
from policies import SPEC, SPEED, Riser
from test_live import Stage

from controller.types import CartesianTarget, Hold, Image
from policy.agent import ActionChunk, Inputs
from studio import messages as m
from studio import tasks
from studio.api import Studio
from studio.episode import open_episode
from studio.evaluation import Evaluation, Rollout
from studio.inputs.policy import Immediate, PolicyAgent, Thinking
from studio.pilot import Playing
from studio.policy_link import PolicyServer, RemotePolicy, connect_to
from studio.session import Session
from studio.twin import Twin

TOKEN = "open sesame"


def until(condition: object, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.fixture
def inputs(twin: Twin) -> Inputs:
    twin.reset(3)
    state = twin.observe().arms[0]
    return Inputs(
        time=0.25,
        base_from_tcp=state.base_from_tcp.vector[None],
        q=state.q[None],
        gripper=np.array([state.gripper]),
        wrench=np.arange(24.0).reshape(4, 1, 6),
        images={"front": np.arange(24, dtype=np.uint8).reshape(2, 4, 3)},
    )


def assert_equal(one: ActionChunk, other: ActionChunk) -> None:
    assert (one.time, one.period) == (other.time, other.period)
    for a, b in zip(one.arms, other.arms, strict=True):
        for field in dataclasses.fields(a):
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_a_policy_drives_a_twin(twin: Twin) -> None:
    twin.reset(3)
    policy, listener = Riser(), Listener()
    start = twin.observe().arms[0].base_from_tcp.position[2]
    Session(twin).run(PolicyAgent(Immediate(policy), seed=5), [listener], time_limit=1.5)
    assert twin.observe().arms[0].base_from_tcp.position[2] - start > 0.5 * SPEED
    assert policy.seeds == [5]
    assert [round(inputs.time, 6) for inputs in policy.shown] == [0.0, 0.5, 1.0]  # every 10 steps of 20 Hz
    assert {step.requested.arms[0].target.stiffness.diagonals[0] for step in listener.steps} == {250.0}
    # Between the steps of a chunk the target moves every tick, so that the servo sees no stairs.
    heights = [step.requested.arms[0].target.base_from_target.position[2] for step in listener.steps[:50]]
    np.testing.assert_allclose(np.diff(heights), SPEED * 0.01, rtol=1e-6)


def test_the_declared_latency_passes_before_the_first_target(twin: Twin) -> None:
    twin.reset(3)
    listener = Listener()
    Session(twin).run(PolicyAgent(Immediate(Riser(), latency=0.08)), [listener], time_limit=0.3)
    kinds = [type(step.requested.arms[0].target) for step in listener.steps]
    assert kinds == [Hold] * 8 + [CartesianTarget] * 22
    first = listener.steps[8].requested.arms[0].target
    begun = listener.steps[0].observation.arms[0].base_from_tcp.position[2]
    assert first.base_from_target.position[2] == pytest.approx(begun + 0.08 * SPEED)  # joined in its middle
    with pytest.raises(ValueError, match="before"):
        Immediate(Riser(), latency=-0.1)


def test_a_policy_that_falls_silent_holds_its_last_target_and_is_counted(twin: Twin) -> None:
    class Mute(Immediate):
        def answer(self, time: float) -> ActionChunk | None:
            return super().answer(time) if time < 0.1 else None

    twin.reset(3)
    listener, agent = Listener(), PolicyAgent(Mute(Riser()))
    Session(twin).run(agent, [listener], time_limit=1.5)
    # 20 steps of 20 Hz end at 0.95 s.
    assert agent.late == 150 - 96
    last, before = (listener.steps[n].requested.arms[0].target for n in (-1, -20))
    np.testing.assert_array_equal(last.base_from_target.vector, before.base_from_target.vector)


def test_time_that_begins_anew_begins_a_new_run(twin: Twin) -> None:
    twin.reset(3)
    policy = Riser()
    agent, session = PolicyAgent(Immediate(policy, latency=0.05)), Session(twin)
    agent.reset(twin.observe())
    for _ in range(130):
        session.tick(agent)
    twin.restart_time()  # a take begins
    listener = Listener()
    for tick in range(30):
        session.tick(agent, [listener], tick)
    assert policy.shown[-1].time == 0.0
    targets = [step.requested.arms[0].target for step in listener.steps]
    assert [type(target) for target in targets[:6]] == [Hold] * 5 + [CartesianTarget]
    height = listener.steps[0].observation.arms[0].base_from_tcp.position[2]
    assert targets[5].base_from_target.position[2] == pytest.approx(height, abs=0.005)


def test_a_hand_that_holds_a_part_does_not_loosen_its_grip() -> None:
    twin = Twin(tasks.load("peg-cylinder"))
    twin.reset(3)
    observation = twin.observe()
    assert min(arm.gripper for arm in observation.arms) > 0.2  # as far as the parts let the hands close
    assert twin.grippers == (0.0, 0.0)
    spec = dataclasses.replace(SPEC, task="peg-cylinder", arms=("left", "right"))
    agent = PolicyAgent(Immediate(Riser(spec), latency=0.05), grippers=twin.grippers)
    agent.reset(observation)
    session, listener = Session(twin), Listener()
    for _ in range(20):
        session.tick(agent, [listener])
    twin.restart_time()  # a take begins
    for _ in range(3):
        session.tick(agent, [listener])
    assert {arm.gripper for step in listener.steps for arm in step.requested.arms} == {0.0}


def test_an_answer_to_somebody_before_is_dropped(twin: Twin) -> None:
    twin.reset(3)
    mind = Immediate(Riser(), latency=0.5)
    session = Session(twin)
    for ticks in (10, 100):  # the first is gone before its answer comes; it would move the arm back
        agent = PolicyAgent(mind)
        agent.reset(twin.observe())
        mind.reset = lambda seed: None  # type: ignore[method-assign]
        steps = [session.tick(agent) for _ in range(ticks)]
    kinds = [type(step.requested.arms[0].target) for step in steps if step]
    assert kinds == [Hold] * 50 + [CartesianTarget] * 50


def test_images_of_before_the_reset_are_not_shown(twin: Twin) -> None:
    twin.reset(3)
    policy = Riser(dataclasses.replace(SPEC, cameras={"front": (2, 2)}))
    agent, observation = PolicyAgent(Immediate(policy)), twin.observe()
    pixels = np.zeros((4, 4, 3), np.uint8)
    stale = dataclasses.replace(observation, images={"front": Image(12.0, pixels)})
    fresh = dataclasses.replace(observation, images={"front": Image(0.0, pixels)})
    agent.reset(stale)
    agent.act(stale)
    assert policy.shown == []
    agent.act(fresh)
    assert len(policy.shown) == 1


def test_a_thinking_policy_never_keeps_the_loop_waiting(inputs: Inputs) -> None:
    thinks = threading.Event()

    class Slow(Riser):
        def predict(self, inputs: Inputs) -> ActionChunk:
            thinks.wait(10)
            return super().predict(inputs)

    policy = Slow()
    mind = Thinking(SPEC, lambda: policy)
    begun = time.monotonic()
    for number in range(5):
        mind.ask(dataclasses.replace(inputs, time=float(number)), 0.0)
        assert mind.answer(0.0) is None
        time.sleep(0.01)
    assert time.monotonic() - begun < 1.0
    thinks.set()
    until(lambda: len(policy.shown) == 2)
    assert policy.shown[-1].time == 4.0  # the newest question; those between were overtaken
    until(lambda: (chunk := mind.answer(0.0)) is not None and chunk.time == 4.0)
    assert mind.answer(0.0) is None
    mind.close()


@pytest.mark.parametrize("when", ["loading", "thinking"])
def test_what_stops_a_policy_is_told(inputs: Inputs, when: str) -> None:
    def open_policy() -> Riser:
        if when == "loading":
            raise RuntimeError("no weights")
        return Riser()

    mind = Thinking(SPEC, open_policy)
    mind.ask(dataclasses.replace(inputs, wrench=np.full((4, 1, 6), np.nan)), 0.0)
    until(lambda: mind.error)
    assert ("no weights" if when == "loading" else "not finite") in str(mind.error)


# The WebSocket


def test_a_remote_policy_answers_like_the_policy_itself(inputs: Inputs) -> None:
    with PolicyServer(Riser(), TOKEN) as server:
        remote = RemotePolicy(server.address, TOKEN)
        assert remote.spec == SPEC
        remote.reset(9)
        assert_equal(remote.predict(inputs), Riser().predict(inputs))
        remote.close()
        until(server.left.is_set)
        (shown,) = server._policy.shown  # type: ignore[attr-defined]
        for name in ("base_from_tcp", "q", "gripper", "wrench"):
            np.testing.assert_array_equal(getattr(shown, name), getattr(inputs, name))
        np.testing.assert_array_equal(shown.images["front"], inputs.images["front"])


def test_a_question_that_cannot_be_answered_does_not_end_the_server(inputs: Inputs) -> None:
    with PolicyServer(Riser(), TOKEN) as server:
        remote = RemotePolicy(server.address, TOKEN)
        with pytest.raises(ValueError, match="not finite"):
            remote.predict(dataclasses.replace(inputs, wrench=np.full((4, 1, 6), np.inf)))
        assert remote.predict(inputs).time == 0.25
        remote.close()


def test_strangers_are_kept_out(monkeypatch: pytest.MonkeyPatch) -> None:
    with PolicyServer(Riser(), TOKEN) as server:
        with pytest.raises(ConnectionError, match="STUDIO_POLICY_TOKEN"):
            RemotePolicy(server.address, "guess")
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(server.address.replace("ws", "http", 1))
        monkeypatch.delenv("STUDIO_POLICY_TOKEN", raising=False)
        with pytest.raises(ConnectionError, match="Set STUDIO_POLICY_TOKEN"):
            connect_to(server.address)
    with pytest.raises(ConnectionError, match="No policy answers"):
        RemotePolicy(server.address, TOKEN)


@pytest.mark.parametrize(
    "message",
    [
        b"\x80\x04K\x01.",  # a pickle
        msgspec.msgpack.encode({"type": "Question", "time": 0.0, "arrays": {}, "images": {}}),
        msgspec.msgpack.encode(
            {"type": "Question", "time": 0.0, "arrays": {"q": ["|O8", [1], b"12345678"]}, "images": {}}
        ),
        msgspec.msgpack.encode(
            {"type": "Question", "time": 0.0, "arrays": {}, "images": {"front": ["|u1", [-1, 9], b""]}}
        ),
    ],
)
def test_anything_else_is_refused(message: bytes, inputs: Inputs) -> None:
    with PolicyServer(Riser(), TOKEN) as server:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        with websockets.sync.client.connect(server.address, additional_headers=headers) as link:
            link.recv()  # hello
            link.send(message)
            assert b"Sorry" in link.recv()
        remote = RemotePolicy(server.address, TOKEN)
        assert remote.predict(inputs).time == 0.25
        remote.close()


def test_a_server_of_another_version_is_told() -> None:
    def greet(link: websockets.sync.server.ServerConnection) -> None:
        link.send(msgspec.msgpack.encode({"type": "Hello", "spec": {"run": "riser", "task": "wiping"}}))

    with websockets.sync.server.serve(greet, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with pytest.raises(ConnectionError, match="speaks another version of the studio"):
            RemotePolicy(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", TOKEN)
        server.shutdown()
        thread.join()


def test_a_server_that_goes_is_told(inputs: Inputs) -> None:
    with PolicyServer(Riser(), TOKEN) as server:
        remote = RemotePolicy(server.address, TOKEN)
    with pytest.raises(ConnectionError, match="hung up"):
        remote.predict(inputs)
    remote.close()


# Live


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    blank.untrained(tmp_path / "runs" / "blank", "wiping")
    blank.untrained(tmp_path / "runs" / "other", "drawing")
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def test_a_person_takes_over_and_hands_back(stage: Stage) -> None:
    with Studio(stage.data) as studio:
        assert studio.runs_of("wiping") == ["blank"]
    stage.link.send(m.Drive(driver="policy", operator="ana", policy="blank", replan_every=20))
    stage.wait(lambda: stage.status.driver == "policy" and stage.status.policy == "blank")
    start = stage.arm.base_from_target
    # It wants the very pose that it sees; that its target has moved at all says that it was asked.
    stage.wait(lambda: stage.arm.base_from_target != start, seconds=60)
    stage.link.send(m.StartTake(countdown=0.0))
    stage.wait(lambda: stage.status.take_seconds > 0.5)
    assert not stage.status.arms[0].engaged
    stage.move(0.0, 0.0, 0.02)
    stage.wait(lambda: stage.status.driver == "operator" and stage.status.arms[0].engaged)
    held = stage.arm.base_from_target
    time.sleep(0.3)
    assert stage.arm.base_from_target == pytest.approx(held, abs=1e-3)  # no answer of the policy moves it
    stage.link.send(m.Drive(driver="policy", operator="ana"))
    stage.wait(lambda: stage.status.driver == "policy", seconds=5)
    seconds = stage.status.take_seconds
    stage.wait(lambda: stage.status.take_seconds > seconds + 0.5)
    assert stage.status.policy_late < 50  # its process was kept: it drives at once
    stage.link.send(m.EndTake())
    stage.wait(lambda: stage.heard("take kept"))
    with open_episode(Path(stage.last_take().path)) as episode:
        told = [event.text for event in episode.events() if event.kind == "driver"]
        assert told == ["operator ana", "policy blank"]
        assert episode.header.agent == "blank"
        assert episode.header.provenance == {
            "run": "blank",
            "step": 7,
            "execution": "replan",
            "replan_every": 20,
        }


def test_a_policy_that_cannot_drive_so_is_refused(stage: Stage) -> None:
    for run, steps, words in (
        ("other", None, "learned 'drawing'"),
        ("nowhere", None, "No run 'nowhere'; there are"),
        ("blank", 10_000, "it cannot be asked less often"),
    ):
        stage.notices.clear()
        stage.link.send(m.Drive(driver="policy", policy=run, replan_every=steps))
        stage.wait(lambda: stage.heard("error"))
        assert words in stage.notices[-1].text
        assert stage.status.driver == "nobody"


def test_what_did_best_when_evaluated_comes_first(tmp_path: Path) -> None:
    blank.untrained(tmp_path / "runs" / "blank", "wiping")

    def evaluated(name: str, every: int, successes: int, hidden: tuple[str, ...] = ()) -> None:
        provenance = {"execution": "replan", "replan_every": every, "hidden": hidden}
        rollouts = tuple(Rollout(seed, seed < successes) for seed in range(10))
        Evaluation(name, 0.0, "blank", "wiping", 1.0, provenance, {}, rollouts, {}).save(tmp_path)

    with Studio(tmp_path) as studio:
        ways = studio.ways_to_play("blank")
        assert ways[0].playing == Playing("replan", 10), "the usual one, as nothing is known"
        evaluated("a", 10, 2)
        evaluated("b", 5, 7)
        evaluated("c", 5, 6)
        evaluated("d", 20, 9, hidden=("wrench",))
        best, second, *rest = studio.ways_to_play("blank")
    assert (best.playing, best.successes, best.trials) == (Playing("replan", 5), 13, 20)
    assert (second.playing, second.successes) == (Playing("replan", 10), 2)
    assert all(not way.trials for way in rest)


def test_the_arms_hold_when_a_policy_dies(stage: Stage) -> None:
    (stage.data / "runs" / "blank" / "checkpoints" / "last" / "model.safetensors").write_bytes(b"no tensors")
    stage.link.send(m.Drive(driver="policy", policy="blank"))
    stage.wait(lambda: stage.heard("error"), seconds=60)
    assert "The arms hold." in stage.notices[-1].text
    stage.wait(lambda: stage.status.driver == "nobody")
