"""What is written is read back, to the bit; what is torn is recovered; what is wrong is told."""

from __future__ import annotations

import dataclasses
import fcntl
import functools
import io
import json
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from mcap.writer import Writer

from controller.types import (
    Action,
    ArmAction,
    CartesianTarget,
    Hold,
    Image,
    JointTarget,
    Limit,
    Pose,
    Release,
    Step,
    Stiffness,
    Wrench,
    rotation_of,
)
from studio import episode as episodes
from studio import schema
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.episode import Episode, EpisodeError, Event, Header, Outcome, open_episode
from studio.episode_writer import EpisodeWriter
from studio.recovery import recover, recover_all

DONE = Outcome(True, "done", 0.9)


def write(path: Path, steps: Sequence[Step], header: Header, outcome: Outcome = DONE) -> Path:
    writer = EpisodeWriter(path, header)
    for number, step in enumerate(steps):
        writer.add(step, 1000.0 + number)
        if number % 10 == 9:
            writer.flush()
    return writer.finish(outcome)


def bits(action: Action) -> list[tuple[object, ...]]:
    """What must be equal for two actions to be equal to the bit."""
    found: list[tuple[object, ...]] = []
    for arm in action.arms:
        match arm.target:
            case CartesianTarget(pose, stiffness):
                numbers = [pose.vector.tobytes(), stiffness.vector.tobytes()]
            case JointTarget(q):
                numbers = [q.tobytes()]
            case _:
                numbers = []
        found.append((type(arm.target), *numbers, np.float64(arm.gripper).tobytes()))
    return found


def varied(steps: Sequence[Step]) -> list[Step]:
    """The steps with every kind of target in turn, odd numbers among them, and limits."""
    dense = np.diag([1e3, 2e3, 3e3]) + 0.1 * np.ones((3, 3))
    odd = np.array([np.nan, -0.0, 5e-324, np.inf, 1 / 3, -1.7e308])
    targets = (
        CartesianTarget(Pose(odd[:3], np.array([0.6, 0.0, -0.8, 0.0])), Stiffness(dense, 2 * dense)),
        JointTarget(odd),
        Hold(),
        Release(),
    )
    changed = []
    for number, step in enumerate(steps):
        action = Action(tuple(ArmAction(targets[(number + arm) % 4], 0.1 * arm) for arm in range(2)))
        limits = (Limit(1, "contact_force", "pressed with 61 N", refused=True),) if number % 7 == 3 else ()
        applied = dataclasses.replace(step.applied, limits=limits)
        changed.append(dataclasses.replace(step, requested=action, applied=applied, late=0.001 * number))
    return changed


@pytest.fixture(scope="module")
def header() -> Header:
    return made_up_header()


@pytest.fixture(scope="module")
def steps(header: Header) -> list[Step]:
    return varied(list(made_up_steps(120, header)))


@pytest.fixture(scope="module")
def path(header: Header, steps: list[Step], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("takes") / "take.mcap", steps, header)


@pytest.fixture
def episode(path: Path) -> Iterator[Episode]:
    with open_episode(path) as episode:
        yield episode


def test_header_and_outcome_read_back(episode: Episode, header: Header) -> None:
    assert episode.header == header
    assert episode.outcome == DONE
    assert episode.duration == pytest.approx(1.2, abs=1e-9)


def test_actions_read_back_to_the_bit(episode: Episode, steps: list[Step]) -> None:
    assert [bits(a) for a in episode.actions()] == [bits(step.requested) for step in steps]
    assert [bits(a) for a in episode.actions("applied")] == [bits(step.applied.action) for step in steps]


def test_states_read_back_to_the_bit(episode: Episode, steps: list[Step]) -> None:
    columns = episode.columns("left/state", "right/state")
    assert {name.rsplit("/", 1)[0] for name in columns} == {"left/state", "right/state"}
    for arm, name in enumerate(("left", "right")):
        first = steps[0].observation.arms[arm]
        rows = np.concatenate([step.applied.trace[arm] for step in steps])
        for field, part in schema.ARM_ROW.items():
            column = columns[f"{name}/state/{field}"].reshape(len(rows) + 1, -1)
            assert column[1:].tobytes() == rows[:, part].tobytes(), field
        assert columns[f"{name}/state/time"][0] == first.time
        assert np.array_equal(columns[f"{name}/state/wrench"][0], first.wrench.vector)
        assert np.array_equal(columns[f"{name}/state/base_from_tcp"][0], first.base_from_tcp.vector)


def test_a_tick_finds_its_state_and_its_wall_time(episode: Episode, steps: list[Step]) -> None:
    columns = episode.columns()
    ticks = columns["tick/time"]
    assert ticks.tolist() == [step.observation.time for step in steps]
    assert np.array_equal(columns["left/state/time"][::5][: len(ticks)], ticks)
    assert columns["tick/wall"].tolist() == [1000.0 + n for n in range(120)]
    assert columns["tick/late"].tolist() == [0.001 * n for n in range(120)]
    assert columns["right/requested/kind"][:5].tolist() == ["joint", "hold", "release", "cartesian", "joint"]
    assert np.isnan(columns["right/requested/base_from_target"][0]).all()
    assert episode.digests() == [step.digest for step in steps]


def test_the_first_state_is_recorded_once(tmp_path: Path, header: Header, steps: list[Step]) -> None:
    """Also where a robot's trace begins with the state that it observed."""
    first = steps[0]
    trace = first.applied.trace.copy()
    trace[:, :, 0] -= 0.002
    early = dataclasses.replace(first, applied=dataclasses.replace(first.applied, trace=trace))
    for name, step in (("late", first), ("early", early)):
        with open_episode(write(tmp_path / f"{name}.mcap", [step], header)) as episode:
            times = episode.columns("left/state")["left/state/time"]
            assert times[0] == 0.0
            assert np.all(np.diff(times) > 0.001)


def test_task_states_and_snapshots_read_back_to_the_bit(episode: Episode, steps: list[Step]) -> None:
    told = [(s.observation.time, s.task_state) for s in steps if s.task_state is not None]
    for (time, read), (recorded_time, recorded) in zip(episode.task_states(), told, strict=True):
        assert time == recorded_time
        assert_same_arrays(read, recorded)
    saved = [(s.observation.time, s.snapshot.arrays) for s in steps if s.snapshot is not None]
    for (time, snapshot), (recorded_time, recorded) in zip(episode.snapshots(), saved, strict=True):
        assert time == recorded_time
        assert_same_arrays(snapshot.arrays, recorded)
    assert_same_arrays(episode.task_state_at(0.0999), told[1][1])  # 0.05 s, not 0.10 s
    assert_same_arrays(episode.task_state_at(-1.0), told[0][1])


def assert_same_arrays(read: object, recorded: object) -> None:
    assert isinstance(read, dict)
    assert isinstance(recorded, dict)
    assert read.keys() == recorded.keys()
    for name, array in recorded.items():
        array = np.asarray(array)
        assert (read[name].dtype, read[name].shape) == (array.dtype, array.shape), name
        assert read[name].tobytes() == array.tobytes(), name


@pytest.mark.parametrize(
    "array",
    [
        np.float64(0.1),
        np.zeros((0, 3), np.float32),
        np.array([True, False]),
        np.array(["peg", "hole"]),
        np.asfortranarray(np.arange(6, dtype=">i2").reshape(2, 3)),
        np.arange(10)[::-3],
        np.array([np.nan, -0.0]),
    ],
)
def test_any_array_of_numbers_or_text_is_kept(array: np.ndarray) -> None:
    time, read = schema.decode_arrays(schema.arrays_message(0.3, {"x": array}).SerializeToString())
    assert time == 0.3
    assert_same_arrays(read, {"x": array})


@given(arrays(np.uint64, (3, 33)))
def test_packed_rows_keep_every_bit_and_are_what_protobuf_says(words: np.ndarray) -> None:
    rows = words.view(np.float64)
    wires = schema.STATE.encode(rows)
    read = schema.STATE.decode(np.frombuffer(b"".join(wires), np.uint8).reshape(3, -1))
    parsed = [schema.message("studio.v1.ArmState").FromString(wire) for wire in wires]
    for name, part in schema.ARM_ROW.items():
        assert read[name].tobytes() == rows[:, part].tobytes()
        assert np.array([getattr(p, name) for p in parsed]).tobytes() == rows[:, part].tobytes()


@given(st.floats(), st.lists(st.floats(), min_size=6, max_size=6))
def test_an_action_is_what_protobuf_says(gripper: float, q: list[float]) -> None:
    (wire,) = schema.encode_actions(0.5, [ArmAction(JointTarget(np.array(q)), gripper)])
    parsed = schema.message("studio.v1.ArmAction").FromString(wire)
    assert parsed.kind == parsed.Kind.Value("JOINT")
    assert np.array(parsed.q).tobytes() == np.array(q).tobytes()
    assert np.array(parsed.gripper).tobytes() == np.array([gripper]).tobytes()


def test_limits_and_events_read_back(tmp_path: Path, header: Header, steps: list[Step]) -> None:
    writer = EpisodeWriter(tmp_path / "take.mcap", header)
    writer.add_event(Event(0.0, "started", "by hand"))
    for step in steps:
        writer.add(step, 0.0)
    writer.add_event(Event(writer.time, "operator", "Ana took over"))
    with open_episode(writer.finish(Outcome(None, "stopped"))) as episode:
        told = [(s.observation.time, s.applied.limits) for s in steps if s.applied.limits]
        assert episode.limits() == told
        assert [event.kind for event in episode.events()] == ["started", "operator"]
        assert episode.events()[1].time == steps[-1].applied.trace[0, -1, 0]
        assert episode.outcome.success is None


def test_each_image_is_kept_once_and_pairs_with_the_state_it_shows(tmp_path: Path, header: Header) -> None:
    steps = list(made_up_steps(41, header))
    newest: dict[str, Image] = {}
    for number, step in enumerate(steps):
        newest = {**newest, **step.observation.images}  # a robot keeps showing its newest image
        late = steps[max(0, number - 2)].observation.time  # a camera that is two ticks behind
        images = {c: dataclasses.replace(i, time=late) if c == "front" else i for c, i in newest.items()}
        images = {c: i for c, i in images.items() if c != "front" or number % 5 == 2}
        steps[number] = dataclasses.replace(
            step, observation=dataclasses.replace(step.observation, images=images)
        )
    with open_episode(write(tmp_path / "take.mcap", steps, header)) as episode:
        times = episode.columns("tick")["tick/time"]
        assert episode.image_ticks("left_wrist").tolist() == list(range(0, 41, 5))
        assert episode.image_ticks("front").tolist() == list(range(0, 40, 5))
        assert np.abs(times[episode.image_ticks("front")] - episode.image_times("front")).max() < 1e-9
        assert episode.jpeg("left_wrist", 3) == steps[15].observation.images["left_wrist"].jpeg


def test_pixels_come_back_as_rgb(tmp_path: Path) -> None:
    header = made_up_header(cameras=("front",))
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 0] = 255
    (step,) = made_up_steps(1, header)
    seen = dataclasses.replace(step.observation, images={"front": Image(0.0, red)})
    take = write(tmp_path / "take.mcap", [dataclasses.replace(step, observation=seen)], header)
    with open_episode(take) as episode:
        image = episode.image_at("front", 0.5)
        assert image.shape == red.shape
        assert np.abs(image.astype(int) - red).max() < 3  # blue (0, 0, 255) if the channels were swapped


def test_a_wrong_name_is_answered_with_what_exists(episode: Episode) -> None:
    with pytest.raises(KeyError, match=r"No camera 'top'; this episode has .*'front', 'left_wrist'"):
        episode.image("top", 0)
    with pytest.raises(IndexError, match="No image 24 of camera 'front'; this episode has 24"):
        episode.image("front", 24)
    with pytest.raises(KeyError, match=r"No columns 'left/force'; .*'left/state'"):
        episode.columns("left/force")


def test_a_camera_that_sent_nothing_has_no_images(tmp_path: Path, header: Header) -> None:
    steps = [
        dataclasses.replace(step, observation=dataclasses.replace(step.observation, images={}))
        for step in made_up_steps(3, header)
    ]
    with open_episode(write(tmp_path / "take.mcap", steps, header)) as episode:
        assert episode.cameras == ("front", "left_wrist", "right_wrist")
        assert episode.image_times("front").shape == (0,)


def test_a_take_without_steps_is_a_take(tmp_path: Path, header: Header) -> None:
    with open_episode(write(tmp_path / "take.mcap", [], header)) as episode:
        assert episode.duration == 0.0
        assert episode.actions() == []
        assert episode.columns()["left/state/q"].shape == (0, 6)
        assert list(episode.snapshots()) == []


def test_a_step_that_cannot_be_recorded_leaves_nothing_behind(tmp_path: Path, header: Header) -> None:
    first, second = made_up_steps(2, header)
    writer = EpisodeWriter(tmp_path / "take.mcap", header)
    writer.add(first, 0.0)
    with pytest.raises(TypeError, match="Array 'board' of dtype object cannot be recorded"):
        writer.add(dataclasses.replace(second, task_state={"board": np.array([object()])}), 0.0)
    with pytest.raises(ValueError, match="A step of 1 arms in a take of"):
        writer.add(next(made_up_steps(1, made_up_header(arms=("right",)))), 0.0)
    with open_episode(writer.finish(DONE)) as episode:
        assert {len(c) for n, c in episode.columns().items() if "/state/" not in n} == {1}


def test_a_take_is_never_overwritten(tmp_path: Path, header: Header) -> None:
    path = write(tmp_path / "take.mcap", [], header)
    with pytest.raises(FileExistsError, match="takes are never overwritten"):
        EpisodeWriter(path, header)
    writer = EpisodeWriter(tmp_path / "other.mcap", header)
    with pytest.raises(FileExistsError):
        EpisodeWriter(tmp_path / "other.mcap", header)
    writer.finish(DONE)


# The header


def test_a_header_keeps_what_it_does_not_know(header: Header) -> None:
    text = json.dumps({**json.loads(header.to_json()), "wind": [1, 2]})
    read = Header.from_json(text)
    assert read.extra == {"wind": [1, 2]}
    assert Header.from_json(read.to_json()) == read
    assert dataclasses.replace(read, extra={}) == header


def test_an_older_header_is_migrated(header: Header, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = json.loads(header.to_json())
    fields["job"] = fields.pop("task")
    old = json.dumps({**fields, "format_version": 0})
    with pytest.raises(EpisodeError, match="No migration from format version 0"):
        Header.from_json(old)
    monkeypatch.setitem(episodes.MIGRATIONS, 0, lambda f: {**f, "task": f["job"]})
    assert Header.from_json(old).task == header.task
    assert Header.from_json(old).format_version == 1


def test_a_newer_take_is_refused_with_a_sentence(tmp_path: Path, header: Header) -> None:
    path = write(tmp_path / "take.mcap", [], dataclasses.replace(header, format_version=2))
    with pytest.raises(EpisodeError, match="format version 2, this Studio reads up to 1: update Studio"):
        open_episode(path)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"format_version": 1}',
        "not json",
        '{"format_version": "new"}',
        '{"format_version": 1, "cameras": {"a": 1}}',
    ],
)
def test_what_is_no_header_is_refused(text: str) -> None:
    with pytest.raises(EpisodeError, match="header of the take cannot be read"):
        Header.from_json(text)


@pytest.mark.parametrize("change", [{"task": "../x"}, {"arms": ("a/b",)}, {"arms": ()}, {"episode_id": ""}])
def test_names_that_would_leave_their_folder_are_refused(header: Header, change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"cannot be part of|at least one arm"):
        dataclasses.replace(header, **change)  # type: ignore[arg-type]


# Files that are no takes


def test_a_file_that_is_no_take_is_told_apart(tmp_path: Path, path: Path) -> None:
    whole = path.read_bytes()
    foreign = io.BytesIO()
    writer = Writer(foreign)
    writer.start()
    channel = writer.register_channel("/chat", "json", writer.register_schema("text", "jsonschema", b"{}"))
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    damaged = bytearray(whole)
    damaged[len(whole) // 3 : len(whole) // 3 + 1000] = bytes(1000)
    for content, complaint in (
        (b"", "is empty"),
        (b"PK\x03\x04 some other file", "is not an MCAP file"),
        (whole[:8], "is torn: its end is missing. `studio recover`"),
        (whole[:-1], "is torn"),
        (whole[: len(whole) // 2], "is torn"),
        (foreign.getvalue(), r"file\.mcap: This is an MCAP file, but not a take of Studio: it has no header"),
        (bytes(damaged), "is damaged"),
    ):
        file = tmp_path / "file.mcap"
        file.write_bytes(content)
        with pytest.raises(EpisodeError, match=complaint), open_episode(file) as episode:
            episode.columns()
    with pytest.raises(FileNotFoundError):
        open_episode(tmp_path / "none.mcap")


# Other readers


def test_the_official_reader_reads_all_of_it(path: Path, steps: list[Step]) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_messages())
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages)
    counts = {topic: 0 for topic in sorted(channel.topic for _, channel, _ in messages)}
    for _, channel, _ in messages:
        counts[channel.topic] += 1
    assert counts["/left/state"] == 1 + 5 * len(steps)
    assert counts["/tick"] == counts["/right/applied"] == len(steps)
    assert counts["/tf"] == counts["/forces"] == counts["/left/tcp_pose"] == 36  # 1.2 s at 30 Hz
    with path.open("rb") as file:
        in_file_order = make_reader(file).iter_messages(log_time_order=False)
        assert next(in_file_order)[1].topic == "/header"


def test_the_schemas_in_the_file_decode_its_messages(path: Path, steps: list[Step]) -> None:
    seen: dict[str, object] = {}
    with path.open("rb") as file:
        for described, _, message in make_reader(file).iter_messages():
            assert described is not None
            if described.name not in seen:
                pool = descriptor_pool.DescriptorPool()
                for part in descriptor_pb2.FileDescriptorSet.FromString(described.data).file:
                    pool.Add(part)
                parse = message_factory.GetMessageClass(pool.FindMessageTypeByName(described.name))
                seen[described.name] = parse.FromString(message.data)
    joints = seen["foxglove.JointStates"].joints  # type: ignore[attr-defined]
    assert [name for joint in joints for name in joint.name][:2] == ["left_joint_1", "left_joint_2"]
    assert list(joints[1].position) == steps[0].observation.arms[1].q.tolist()
    transforms = seen["foxglove.FrameTransforms"].transforms  # type: ignore[attr-defined]
    assert [(t.parent_frame_id, t.child_frame_id) for t in transforms] == [
        ("left_base", "left_tcp"),
        ("right_base", "right_tcp"),
    ]


@functools.cache
def one_step() -> Step:
    return next(made_up_steps(1, made_up_header()))


@given(force=st.lists(st.floats(-50, 50), min_size=3, max_size=3))
def test_a_force_arrow_points_along_the_force(force: list[float]) -> None:
    step = one_step()
    left, right = step.observation.arms
    pressed = dataclasses.replace(right, wrench=Wrench(np.array(force), np.zeros(3)))
    seen = dataclasses.replace(step.observation, arms=(left, pressed))
    arms = (schema.ArmView("left", (), None), schema.ArmView("right", ("joint_1",), Pose.identity()))
    view = {topic: message for topic, _, message in schema.view(0, arms, seen, step.requested)}
    entity = view["/forces"].entities[1]
    arrow = entity.arrows[0]
    turn = arrow.pose.orientation
    along = rotation_of(np.array([turn.w, turn.x, turn.y, turn.z]))[:, 0]
    assert np.abs(along * arrow.shaft_length / schema.ARROW_LENGTH - force).max() < 1e-6
    assert (arrow.pose.position.x, arrow.pose.position.z) == tuple(right.base_from_tcp.position[[0, 2]])
    assert entity.frame_id == "right_base"
    assert [t.child_frame_id for t in view["/tf"].transforms] == ["right_base", "left_tcp", "right_tcp"]


def test_rerun_reads_images_poses_and_forces(path: Path, steps: list[Step]) -> None:
    from rerun.chunk import McapReader

    entities: dict[str, set[str]] = {}
    rows = 0
    for chunk in McapReader(path).stream():
        batch = chunk.to_record_batch()
        entities.setdefault(str(chunk.entity_path), set()).update(map(str, batch.schema.names))
        if str(chunk.entity_path) == "/right/state" and not chunk.is_static:
            rows += batch.num_rows
    assert any("EncodedImage" in name for name in entities["/camera/front"])
    assert any("InstancePoses3D" in name for name in entities["/right/tcp_pose"])
    assert any("Transform3D" in name for name in entities["/tf"])
    assert any("studio.v1.ArmState" in name for name in entities["/right/state"])  # wrench: 6 of its numbers
    assert rows == 1 + 5 * len(steps)


# Recovery


def torn(folder: Path, header: Header, steps: Sequence[Step]) -> Path:
    """A `.part` whose writer died, with one chunk for every ten steps."""
    writer = EpisodeWriter(folder / "episodes" / "made-up" / "take.mcap", header)
    for number, step in enumerate(steps):
        writer.add(step, 0.0)
        if number % 10 == 9:
            writer.flush()
    writer.close()
    return folder / "episodes" / "made-up" / "take.mcap.part"


@pytest.fixture(scope="module")
def torn_bytes(header: Header, steps: list[Step], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return torn(tmp_path_factory.mktemp("torn"), header, steps[:50]).read_bytes()


@pytest.mark.parametrize("share", [0.03, 0.2, 0.4, 0.55, 0.7, 0.85, 0.999, 1.0])
def test_recovery_brings_back_whole_steps_up_to_the_tear(
    tmp_path: Path, torn_bytes: bytes, steps: list[Step], share: float
) -> None:
    part = tmp_path / "take.mcap.part"
    part.write_bytes(torn_bytes[: round(share * len(torn_bytes))] + (b"" if share < 1 else bytes(4096)))
    recovery = recover(part)
    assert recovery.state == "recovered", recovery.what
    assert recovery.episode is not None
    assert list(tmp_path.iterdir()) == [recovery.episode]
    with open_episode(recovery.episode) as episode:
        actions = [bits(action) for action in episode.actions()]
        assert actions == [bits(step.requested) for step in steps[: len(actions)]]
        assert len(actions) >= 50 * share - 15  # the chunk at the tear, and image sizes that vary
        assert len(episode.columns("right/state")["right/state/time"]) == (
            1 + 5 * len(actions) if actions else 0
        )
        assert episode.digests() == [step.digest for step in steps[: len(actions)]]
        assert [event.kind for event in episode.events()] == ["recovered"]
        assert episode.outcome.success is None
        assert episode.outcome.reason == "recovered after the recording was cut off"


def test_recovery_drops_the_part_of_a_step(tmp_path: Path, header: Header) -> None:
    """Chunks close at 1 MiB too, wherever that is in a step."""
    header = dataclasses.replace(header, cameras={"front": (640, 480)})
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)  # a JPEG of 400 kB
    steps = list(made_up_steps(12, header))
    for number, step in enumerate(steps):
        seen = {"front": Image(step.observation.time, noise)}
        steps[number] = dataclasses.replace(
            step, observation=dataclasses.replace(step.observation, images=seen)
        )
    part = torn(tmp_path, header, steps)
    recovery = recover(part)
    assert recovery.episode is not None
    with open_episode(recovery.episode) as episode:
        lengths = {len(column) for name, column in episode.columns().items() if "/state/" not in name}
        assert len(lengths) == 1  # 11 requested and 10 ticks if it kept half a step
        assert len(episode.image_times("front")) == lengths.pop()


def test_recovery_keeps_the_outcome_of_a_take_that_lacks_only_its_name(tmp_path: Path, path: Path) -> None:
    part = tmp_path / "take.mcap.part"
    part.write_bytes(path.read_bytes())
    recovery = recover(part)
    assert recovery.episode is not None
    with open_episode(recovery.episode) as episode, open_episode(path) as whole:
        assert episode.outcome == DONE
        assert episode.digests() == whole.digests()
        assert episode.header == whole.header


def test_a_take_that_is_being_recorded_is_left_alone(
    tmp_path: Path, header: Header, steps: list[Step]
) -> None:
    writer = EpisodeWriter(tmp_path / "episodes" / "made-up" / "take.mcap", header)
    writer.add(steps[0], 0.0)
    writer.flush()
    (recovery,) = recover_all(tmp_path)
    assert (recovery.state, recovery.episode) == ("live", None)
    with open_episode(writer.finish(DONE)) as episode:
        assert episode.digests() == [steps[0].digest]
    assert recover_all(tmp_path) == []


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"something else", bytes(5000)])
def test_a_part_without_a_take_is_put_aside(tmp_path: Path, content: bytes) -> None:
    for _ in range(2):
        part = tmp_path / "take.mcap.part"
        part.write_bytes(content)
        assert recover(part).state == "unreadable"
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["take.mcap.part.1.unreadable", "take.mcap.part.unreadable"]
    assert all(path.read_bytes() == content for path in tmp_path.iterdir())


def test_a_part_beside_its_finished_take_is_put_aside(tmp_path: Path, torn_bytes: bytes) -> None:
    """As after a crash between the last two steps of a recovery."""
    part = tmp_path / "take.mcap.part"
    part.write_bytes(torn_bytes)
    recovery = recover(part)
    assert recovery.episode is not None
    finished = recovery.episode.read_bytes()
    part.write_bytes(torn_bytes)
    assert recover(part).episode == recovery.episode
    assert recovery.episode.read_bytes() == finished
    assert (tmp_path / "take.mcap.part.duplicate").read_bytes() == torn_bytes


def test_recovery_that_cannot_write_keeps_the_part(tmp_path: Path, torn_bytes: bytes) -> None:
    part = tmp_path / "take.mcap.part"
    part.write_bytes(torn_bytes)
    (tmp_path / "take.mcap.recovering").mkdir()
    recovery = recover(part)
    assert recovery.state == "failed"
    assert "kept as it is" in recovery.what
    assert part.read_bytes() == torn_bytes


def test_log_times_are_simulated_and_publish_times_wall(
    path: Path, header: Header, steps: list[Step]
) -> None:
    with path.open("rb") as file:
        messages = [m for _, c, m in make_reader(file).iter_messages(topics=["/tick"])]
    simulated = [(m.log_time - round(header.started * 1e9)) * 1e-9 for m in messages]
    assert simulated == pytest.approx([step.observation.time for step in steps], abs=1e-9)
    assert all(b.publish_time - a.publish_time == 10**9 for a, b in pairwise(messages))


def test_a_lock_is_held_while_a_take_is_written(tmp_path: Path, header: Header) -> None:
    writer = EpisodeWriter(tmp_path / "take.mcap", header)
    with (tmp_path / "take.mcap.part").open("rb") as file, pytest.raises(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    writer.close()
