"""Another take beside the one under review: where its hands were, what they felt, where they went."""

from __future__ import annotations

import viser

from controller.types import Pose, Wrench
from studio.cursor import Cursor
from studio.ui.marks import Ghost, Rgb, Trail, WrenchMark
from studio.ui.scene import REVIEW, SceneModel

# Of the takes after the first, as `web_assets/episode/takes.js` has them.
COLORS: tuple[Rgb, ...] = ((255, 184, 77), (76, 195, 138), (224, 110, 192))


class Company:
    """Hands without an arm, in the colour that the take has in the plots too."""

    def __init__(self, client: viser.ClientHandle, model: SceneModel, cursor: Cursor, number: int) -> None:
        """`number` counts the takes after the first, from 0."""
        self._cursor = cursor
        root, color = f"{REVIEW}/company/{number}", COLORS[number % len(COLORS)]
        self._root = client.scene.add_frame(root, show_axes=False)
        self._hands = [
            _Hand(client.scene, f"{root}/{arm.name}", model, index, arm.world_from_base, color)
            for index, arm in enumerate(cursor.arms[: len(model.ghosts)])
        ]
        for index, arm in enumerate(cursor.arms[: len(model.ghosts)]):
            Trail(client.scene, f"{root}/trail/{index}", color).show(arm.path(), None)

    def show(self, at: float) -> None:
        """`at` [s] in this take."""
        moment = self._cursor.at(at)
        for hand, arm in zip(self._hands, moment.arms, strict=False):
            hand.show(arm.base_from_tcp, arm.wrench)

    def remove(self) -> None:
        self._root.remove()


class _Hand:
    """One arm's, measured."""

    def __init__(
        self, scene: viser.SceneApi, path: str, model: SceneModel, index: int, base: Pose, color: Rgb
    ) -> None:
        shape = model.ghosts[index]
        self._base, self._tcp_from_body = base, shape.tcp_from_body
        self._ghost = Ghost(scene, f"{path}/hand", shape.palm, color)
        self._wrench = WrenchMark(scene, f"{path}/force", model.first_view)

    def show(self, base_from_tcp: Pose, wrench: Wrench) -> None:
        world_from_tcp = self._base @ base_from_tcp
        body = world_from_tcp @ self._tcp_from_body
        self._ghost.show(body, None, "ok")
        self._wrench.show(world_from_tcp.position, body.position, wrench)
