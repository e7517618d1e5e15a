"""The camera process: positions and painted textures in, JPEGs and pixels out.

`python -m studio.rendering TASK HEIGHT WIDTH [--hide-objects]` reads requests from standard input until it
ends. Each is the head `REQUEST`, float64 positions and, where it has changed, the painted texture; the answer
is, for each camera, the head `ANSWER`, a JPEG and, where asked for, the RGB pixels.
"""

from __future__ import annotations

import os
import struct
import sys

import cv2
import mujoco
import numpy as np

REQUEST = struct.Struct("<II?")  # bytes of positions, bytes of texture, whether pixels are wanted
ANSWER = struct.Struct("<II")  # bytes of the JPEG, bytes of the pixels
READY = b"ready\n"
JPEG_QUALITY = 90


def main(task_name: str, height: int, width: int, hide_objects: bool = False) -> None:
    """Answer requests until standard input ends."""
    from studio import tasks
    from studio.twin import build_model

    # Libraries may print; the answers need a pipe of their own.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    task = tasks.load(task_name)
    model = build_model(task)
    data = mujoco.MjData(model)
    painted = task.texture()
    if hide_objects:
        painted = None
        _hide_objects(model, [arm.grasp.body for arm in task.arms if arm.grasp])
    requests = sys.stdin.buffer
    with mujoco.Renderer(model, height, width) as renderer:
        answers.write(READY)
        answers.flush()
        while len(head := requests.read(REQUEST.size)) == REQUEST.size:
            n_positions, n_texture, want_pixels = REQUEST.unpack(head)
            data.qpos[:] = np.frombuffer(requests.read(n_positions))
            texture = requests.read(n_texture)
            if texture and painted:
                _upload(renderer, model, painted[0], texture)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            for view in task.cameras:
                renderer.update_scene(data, view.name)
                pixels = renderer.render()
                _, jpeg = cv2.imencode(".jpg", pixels[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))
                raw = pixels.tobytes() if want_pixels else b""
                answers.write(ANSWER.pack(len(jpeg), len(raw)) + jpeg.tobytes() + raw)
            answers.flush()


def _hide_objects(model: mujoco.MjModel, held: list[str]) -> None:
    """Make every free body transparent but those that a hand holds from the start."""
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    hidden = [body for body in free if model.body(int(body)).name not in held]
    # Whatever hangs on a free body has it as its root.
    model.geom_rgba[np.isin(model.body_rootid[model.geom_bodyid], hidden), 3] = 0.0


def _upload(renderer: mujoco.Renderer, model: mujoco.MjModel, name: str, pixels: bytes) -> None:
    texture = model.texture(name).id
    start = model.tex_adr[texture]
    model.tex_data[start : start + len(pixels)] = np.frombuffer(pixels, np.uint8)
    renderer._gl_context.make_current()
    mujoco.mjr_uploadTexture(model, renderer._mjr_context, texture)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), "--hide-objects" in sys.argv[4:])
