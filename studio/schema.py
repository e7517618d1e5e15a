"""The messages inside a take: their protobuf schemas, built at run time, and the packing of what they hold.

`studio.v1` messages are the truth. Their numbers are `repeated double` even where there is one: proto3 leaves
a scalar zero off the wire, a packed list has constant size, so that columns decode without protobuf
(`Packed`). `foxglove` messages repeat some of it for viewers; names and numbers of their fields are those of
https://github.com/foxglove/foxglove-sdk (schemas/proto), as of 2026, without the identifiers and lineage.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, assert_never

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2

from controller.types import (
    ARM_ROW,
    Action,
    ArmAction,
    ArmState,
    Array,
    CartesianTarget,
    Hold,
    JointTarget,
    Observation,
    Pose,
    Release,
    Stiffness,
    Target,
)

_PROTO = {
    "studio.v1": """
        message Header { string json = 1; }
        message ArmState {
            repeated double time = 1; repeated double q = 2; repeated double dq = 3;
            repeated double q_command = 4; repeated double base_from_tcp = 5; repeated double wrench = 6;
            repeated double gripper = 7;
        }
        message ArmAction {
            enum Kind { UNKNOWN = 0; CARTESIAN = 1; JOINT = 2; HOLD = 3; RELEASE = 4; }
            Kind kind = 1;
            repeated double time = 2; repeated double base_from_target = 3; repeated double stiffness = 4;
            repeated double q = 5; repeated double gripper = 6;
        }
        message Tick {
            repeated double time = 1; repeated double wall = 2; repeated double late = 3;
            uint64 number = 4; bytes digest = 5;
        }
        message Input {
            repeated double time = 1; repeated double age = 2; repeated double latency = 3;
            repeated double jitter = 4;
        }
        message Limit { uint32 arm = 1; string kind = 2; string why = 3; bool refused = 4; }
        message Limits { repeated double time = 1; repeated Limit limits = 2; }
        message NamedArray {
            string name = 1; string dtype = 2; repeated int64 shape = 3; bytes deflated = 4;
        }
        message Arrays { repeated double time = 1; repeated NamedArray arrays = 2; }
        message Event { repeated double time = 1; string kind = 2; string text = 3; }
        message Outcome {
            repeated double time = 1; optional bool success = 2; string reason = 3;
            double progress = 4;
        }
    """,
    "foxglove": """
        message Vector3 { double x = 1; double y = 2; double z = 3; }
        message Point3 { double x = 1; double y = 2; double z = 3; }
        message Quaternion { double x = 1; double y = 2; double z = 3; double w = 4; }
        message Pose { Vector3 position = 1; Quaternion orientation = 2; }
        message Color { double r = 1; double g = 2; double b = 3; double a = 4; }
        message CompressedImage {
            google.protobuf.Timestamp timestamp = 1; string frame_id = 4; bytes data = 2; string format = 3;
        }
        message JointState {
            google.protobuf.Timestamp timestamp = 1; repeated string name = 2;
            repeated double position = 3; repeated double velocity = 4; repeated double effort = 5;
        }
        message JointStates { google.protobuf.Timestamp timestamp = 1; repeated JointState joints = 2; }
        message FrameTransform {
            google.protobuf.Timestamp timestamp = 1; string parent_frame_id = 2; string child_frame_id = 3;
            Vector3 translation = 4; Quaternion rotation = 5;
        }
        message FrameTransforms { repeated FrameTransform transforms = 1; }
        message PoseInFrame { google.protobuf.Timestamp timestamp = 1; string frame_id = 2; Pose pose = 3; }
        message SceneEntityDeletion {
            enum Type { MATCHING_ID = 0; ALL = 1; }
            google.protobuf.Timestamp timestamp = 1; Type type = 2; string id = 3;
        }
        message KeyValuePair { string key = 1; string value = 2; }
        message ArrowPrimitive {
            Pose pose = 1; double shaft_length = 2; double shaft_diameter = 3;
            double head_length = 4; double head_diameter = 5; Color color = 6;
        }
        message CubePrimitive { Pose pose = 1; Vector3 size = 2; Color color = 3; }
        message SpherePrimitive { Pose pose = 1; Vector3 size = 2; Color color = 3; }
        message CylinderPrimitive {
            Pose pose = 1; Vector3 size = 2; double bottom_scale = 3; double top_scale = 4; Color color = 5;
        }
        message LinePrimitive {
            enum Type { LINE_STRIP = 0; LINE_LOOP = 1; LINE_LIST = 2; }
            Type type = 1; Pose pose = 2; double thickness = 3; bool scale_invariant = 4;
            repeated Point3 points = 5; Color color = 6; repeated Color colors = 7;
            repeated fixed32 indices = 8;
        }
        message TriangleListPrimitive {
            Pose pose = 1; repeated Point3 points = 2; Color color = 3; repeated Color colors = 4;
            repeated fixed32 indices = 5;
        }
        message TextPrimitive {
            Pose pose = 1; bool billboard = 2; double font_size = 3; bool scale_invariant = 4;
            Color color = 5; string text = 6;
        }
        message ModelPrimitive {
            Pose pose = 1; Vector3 scale = 2; Color color = 3; bool override_color = 4; string url = 5;
            string media_type = 6; bytes data = 7;
        }
        message SceneEntity {
            google.protobuf.Timestamp timestamp = 1; string frame_id = 2; string id = 3;
            google.protobuf.Duration lifetime = 4; bool frame_locked = 5; repeated KeyValuePair metadata = 6;
            repeated ArrowPrimitive arrows = 7; repeated CubePrimitive cubes = 8;
            repeated SpherePrimitive spheres = 9; repeated CylinderPrimitive cylinders = 10;
            repeated LinePrimitive lines = 11; repeated TriangleListPrimitive triangles = 12;
            repeated TextPrimitive texts = 13; repeated ModelPrimitive models = 14;
        }
        message SceneUpdate { repeated SceneEntityDeletion deletions = 1; repeated SceneEntity entities = 2; }
    """,
}

_Field = descriptor_pb2.FieldDescriptorProto
_SCALARS = {
    "double": _Field.TYPE_DOUBLE,
    "int64": _Field.TYPE_INT64,
    "uint64": _Field.TYPE_UINT64,
    "uint32": _Field.TYPE_UINT32,
    "fixed32": _Field.TYPE_FIXED32,
    "bool": _Field.TYPE_BOOL,
    "string": _Field.TYPE_STRING,
    "bytes": _Field.TYPE_BYTES,
}
_WELL_KNOWN = (timestamp_pb2.DESCRIPTOR, duration_pb2.DESCRIPTOR)


def _file_of(package: str, text: str) -> Any:
    """FileDescriptorProto of one package, from the part of the proto3 language that `_PROTO` uses."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{package}.proto",
        package=package,
        syntax="proto3",
        dependency=[known.name for known in _WELL_KNOWN],
    )
    words = iter(re.findall(r"[\w.]+|[{}=;]", text))
    for _message in words:
        _read_message(words, file.message_type.add(name=next(words)))
    return file


def _read_message(words: Iterator[str], message: Any) -> None:
    next(words)  # {
    while (word := next(words)) != "}":
        if word == "enum":
            _read_enum(words, message.enum_type.add(name=next(words)))
        else:
            _read_field(word, words, message)


def _read_enum(words: Iterator[str], enum: Any) -> None:
    next(words)  # {
    while (name := next(words)) != "}":
        _equals, number, _semicolon = next(words), next(words), next(words)
        enum.value.add(name=name, number=int(number))


def _read_field(word: str, words: Iterator[str], message: Any) -> None:
    label = word if word in ("repeated", "optional") else ""
    kind = next(words) if label else word
    name, _equals, number, _semicolon = next(words), next(words), next(words), next(words)
    field = message.field.add(name=name, number=int(number), label=_Field.LABEL_OPTIONAL)
    if kind in _SCALARS:
        field.type = _SCALARS[kind]
    else:
        field.type_name = kind  # the pool finds out whether it is a message or an enum
    if label == "repeated":
        field.label = _Field.LABEL_REPEATED
    if label == "optional":  # proto3 presence is a oneof of one
        field.proto3_optional = True
        field.oneof_index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")


_POOL = descriptor_pool.DescriptorPool()
for _known in _WELL_KNOWN:
    _POOL.AddSerializedFile(_known.serialized_pb)
for _package, _text in _PROTO.items():
    _POOL.Add(_file_of(_package, _text))

# Of this pool: messages take no part from another.
_TIMESTAMP = message_factory.GetMessageClass(_POOL.FindMessageTypeByName("google.protobuf.Timestamp"))
_CLASSES: dict[str, Any] = {
    descriptor.full_name: message_factory.GetMessageClass(descriptor)
    for package in _PROTO
    for descriptor in _POOL.FindFileByName(f"{package}.proto").message_types_by_name.values()
}


def message(name: str) -> Any:
    """The class of a message, by full name, e.g. "foxglove.PoseInFrame"."""
    return _CLASSES[name]


def descriptor_set(name: str) -> bytes:
    """Serialized FileDescriptorSet that describes the message `name`: the data of an MCAP schema."""
    files = descriptor_pb2.FileDescriptorSet()
    for file in (*_WELL_KNOWN, _CLASSES[name].DESCRIPTOR.file):
        files.file.add().ParseFromString(file.serialized_pb)
    return bytes(files.SerializeToString())


class Packed:
    """Rows of float64 <-> the wire form of `repeated double` fields numbered from `first`, in order."""

    def __init__(self, widths: Mapping[str, int], first: int = 1) -> None:
        self._widths = widths
        template, values = bytearray(), list[int]()
        for number, width in enumerate(widths.values(), first):
            template += bytes((number << 3 | 2, width * 8))  # tag, length: one byte each below 128
            values.extend(range(len(template), len(template) + width * 8))
            template += bytes(width * 8)
        self._template, self._values = np.frombuffer(bytes(template), np.uint8), np.array(values)
        self._tags = np.delete(np.arange(len(template)), values)
        self.size = len(template)  # [bytes] of one message
        self.width = sum(widths.values())

    def encode(self, rows: Array) -> list[bytes]:
        """One message per row of (n, width)."""
        wire = np.empty((len(rows), self.size), np.uint8)
        wire[:] = self._template
        wire[:, self._values] = np.ascontiguousarray(rows, "<f8").view(np.uint8)
        data = wire.tobytes()
        return [data[start : start + self.size] for start in range(0, len(data), self.size)]

    def decode(self, wire: Array) -> dict[str, Array]:
        """From (n, size) uint8: name -> (n, width), or (n,) where the width is one."""
        if (wire[:, self._tags] != self._template[self._tags]).any():
            raise ValueError(f"These messages do not begin with packed {list(self._widths)}.")
        columns, start = {}, 0
        for name, width in self._widths.items():
            start += 2
            column = np.ascontiguousarray(wire[:, start : start + 8 * width]).view("<f8")
            columns[name] = column[:, 0] if width == 1 else column
            start += 8 * width
        return columns


STATE = Packed({name: part.stop - part.start for name, part in ARM_ROW.items()})
TICK = Packed({"time": 1, "wall": 1, "late": 1})  # followed by number and digest
INPUT = Packed({"time": 1, "age": 1, "latency": 1, "jitter": 1})
ACTION = Packed({"time": 1, "base_from_target": 7, "stiffness": 12, "q": 6, "gripper": 1}, first=2)
ACTION_HEAD = 2  # [bytes] before the packed part: the field `kind`, whose values are the index + 1 in
TARGET_KINDS = ("cartesian", "joint", "hold", "release")


def encode_actions(time: float, actions: Sequence[ArmAction]) -> list[bytes]:
    """One `ArmAction` each; NaN where the kind of target has no such number."""
    rows = np.full((len(actions), ACTION.width), np.nan)
    rows[:, 0] = time
    heads = [
        bytes((1 << 3, TARGET_KINDS.index(_fill_row(*pair)) + 1)) for pair in zip(rows, actions, strict=True)
    ]
    return [head + wire for head, wire in zip(heads, ACTION.encode(rows), strict=True)]


def _fill_row(row: Array, action: ArmAction) -> str:
    """Put an action into a row of `ACTION`; return its kind."""
    row[-1] = action.gripper
    match action.target:
        case CartesianTarget(pose, stiffness):
            row[1:8], row[8:20] = pose.vector, stiffness.vector
            return "cartesian"
        case JointTarget(q):
            row[20:26] = q
            return "joint"
        case Hold():
            return "hold"
        case Release():
            return "release"
        case _:
            assert_never(action.target)


def kinds_of(wires: Array) -> Array:
    """(n,) names of the kinds of target, from (n, at least ACTION_HEAD) uint8 of `ArmAction`s."""
    names = np.array(("unknown", *TARGET_KINDS))
    return np.asarray(names[wires[:, 1]])


def target_of(kind: str, base_from_target: Array, stiffness: Array, q: Array) -> Target:
    """From one row of an `ArmAction`'s columns."""
    match kind:
        case "cartesian":
            return CartesianTarget(Pose.from_vector(base_from_target), Stiffness.from_vector(stiffness))
        case "joint":
            return JointTarget(q.copy())
        case "hold":
            return Hold()
        case "release":
            return Release()
    raise ValueError(f"Unknown kind of target {kind!r}; this version knows {TARGET_KINDS}.")


def arrays_message(time: float, arrays: Mapping[str, Array]) -> Any:
    """Named arrays, compressed, to the bit. Numbers, booleans and text only: nothing that needs pickle."""
    named = []
    for name, array in arrays.items():
        array = np.asarray(array)
        if array.dtype.kind not in "biufcSU":
            raise TypeError(f"Array {name!r} of dtype {array.dtype} cannot be recorded; use numbers or text.")
        deflated = zlib.compress(array.tobytes(), 1)
        named.append(
            message("studio.v1.NamedArray")(
                name=name, dtype=array.dtype.str, shape=array.shape, deflated=deflated
            )
        )
    return message("studio.v1.Arrays")(time=[time], arrays=named)


def decode_arrays(wire: bytes) -> tuple[float, dict[str, Array]]:
    """Inverse of `arrays_message`, from its wire form; the arrays are read-only."""
    parsed = message("studio.v1.Arrays").FromString(wire)
    return parsed.time[0], {
        named.name: np.frombuffer(zlib.decompress(named.deflated), named.dtype).reshape(tuple(named.shape))
        for named in parsed.arrays
    }


def compressed_image(ns: int, camera: str, jpeg: bytes) -> Any:
    return message("foxglove.CompressedImage")(
        timestamp=_timestamp(ns), frame_id=camera, data=jpeg, format="jpeg"
    )


@dataclass(frozen=True, slots=True)
class ArmView:
    """What viewers are told of an arm that its states do not hold."""

    name: str
    joints: tuple[str, ...]
    world_from_base: Pose | None

    @property
    def base(self) -> str:
        """Name of its base frame."""
        return f"{self.name}_base"


def view(
    ns: int, arms: tuple[ArmView, ...], observation: Observation, applied: Action
) -> list[tuple[str, str, Any]]:
    """(topic, name of schema, message) that show a state in viewers."""
    both = list(zip(arms, observation.arms, strict=True))
    messages = [
        ("/joint_states", "foxglove.JointStates", _joint_states(ns, both)),
        ("/tf", "foxglove.FrameTransforms", _frame_transforms(ns, both)),
        ("/forces", "foxglove.SceneUpdate", _force_arrows(ns, both)),
    ]
    for (arm, state), action in zip(both, applied.arms, strict=True):
        poses = {"tcp_pose": state.base_from_tcp}
        if isinstance(action.target, CartesianTarget):
            poses["target_pose"] = action.target.base_from_target
        for name, pose in poses.items():
            posed = message("foxglove.PoseInFrame")(
                timestamp=_timestamp(ns), frame_id=arm.base, pose=_pose(pose.position, pose.wxyz)
            )
            messages.append((f"/{arm.name}/{name}", "foxglove.PoseInFrame", posed))
    return messages


_States = list[tuple[ArmView, ArmState]]


def _joint_states(ns: int, arms: _States) -> Any:
    joints = [
        message("foxglove.JointState")(
            timestamp=_timestamp(ns), name=arm.joints, position=state.q.tolist(), velocity=state.dq.tolist()
        )
        for arm, state in arms
    ]
    return message("foxglove.JointStates")(timestamp=_timestamp(ns), joints=joints)


def _frame_transforms(ns: int, arms: _States) -> Any:
    """world -> base, where it is known, -> tcp."""
    tree = [("world", arm.base, arm.world_from_base) for arm, _ in arms if arm.world_from_base is not None]
    tree += [(arm.base, f"{arm.name}_tcp", state.base_from_tcp) for arm, state in arms]
    transforms = [
        message("foxglove.FrameTransform")(
            timestamp=_timestamp(ns),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=_vector(pose.position),
            rotation=_quaternion(pose.wxyz),
        )
        for parent, child, pose in tree
    ]
    return message("foxglove.FrameTransforms")(transforms=transforms)


ARROW_LENGTH = 0.01  # [m/N] of a force arrow


def _force_arrows(ns: int, arms: _States) -> Any:
    """The contact force on each arm, as an arrow that begins at its TCP."""
    entities = []
    for arm, state in arms:
        force = state.wrench.force
        newtons = float(np.linalg.norm(force))
        direction = force / newtons if newtons > 0 else force
        arrow = message("foxglove.ArrowPrimitive")(
            pose=_pose(state.base_from_tcp.position, _turn_x_to(direction)),
            shaft_length=ARROW_LENGTH * newtons,
            shaft_diameter=0.008,
            head_length=0.02 if newtons > 0 else 0.0,
            head_diameter=0.02,
            color=message("foxglove.Color")(r=0.9, g=0.2, b=0.1, a=1.0),
        )
        entity = message("foxglove.SceneEntity")(
            timestamp=_timestamp(ns), frame_id=arm.base, id=f"{arm.name}_force", arrows=[arrow]
        )
        entities.append(entity)
    return message("foxglove.SceneUpdate")(entities=entities)


def _timestamp(ns: int) -> Any:
    return _TIMESTAMP(seconds=ns // 10**9, nanos=ns % 10**9)


def _pose(position: Array, wxyz: Array) -> Any:
    return message("foxglove.Pose")(position=_vector(position), orientation=_quaternion(wxyz))


def _vector(values: Array) -> Any:
    x, y, z = values.tolist()
    return message("foxglove.Vector3")(x=x, y=y, z=z)


def _quaternion(wxyz: Array) -> Any:
    w, x, y, z = wxyz.tolist()
    return message("foxglove.Quaternion")(x=x, y=y, z=z, w=w)


def _turn_x_to(direction: Array) -> Array:
    """wxyz of the shortest turn from +x to a unit vector; identity for the zero vector."""
    x, y, z = direction.tolist()
    sine = math.hypot(y, z)
    half = math.atan2(sine, x) / 2
    axis_y, axis_z = (-z / sine, y / sine) if sine > 0 else (0.0, 1.0)  # half a turn: any axis across x
    return np.array([math.cos(half), 0.0, axis_y * math.sin(half), axis_z * math.sin(half)])
