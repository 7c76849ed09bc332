"""The pictures of an episode, drawn from the saved states of its course: masks, colours, distractors.

Everything drawn at random has a stream of its own per episode, so switching one thing on changes no other.
"""

from typing import Any

import numpy as np

from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.dataset import encoding
from v2p_data.episodes.rollouts import Rollouts
from v2p_data.episodes.staging import Episode
from v2p_data.seeds import rng_for
from v2p_data.sim.env.batch_env import Snapshot
from v2p_data.sim.model.world import World
from v2p_data.sim.render.appearance import furnish
from v2p_data.sim.render.masks import BACKGROUND, WRIST_CAMERA, MaskRenderer
from v2p_data.task.task import TaskBundle


class Artist:
    """Draws episodes.

    Args:
        bundle: the task.
        cfg: what the pictures show; masks are drawn in any case.
        num_threads: for the masks, 0 for all cores; changes no result.
    """

    def __init__(self, bundle: TaskBundle, cfg: EpisodesConfig, num_threads: int) -> None:
        self.bundle, self.cfg, self.num_threads = bundle, cfg, num_threads
        self.is_plain = cfg.distractors.count[1] == 0 and cfg.look.is_off
        self.renderer: MaskRenderer | None = None

    def __enter__(self) -> "Artist":
        return self

    def __exit__(self, *_: object) -> None:
        if self.renderer is not None:
            self.renderer.close()

    def episode(self, rollouts: Rollouts, world: int, episode_id: str) -> Episode:
        """Return the episode of a world with its pictures."""
        bundle, cfg = self.bundle, self.cfg
        length = int(rollouts.num_frames[world])
        labels, rgb_mp4, drawn = self._pictures(rollouts, world, length, episode_id)
        return Episode(
            id=episode_id,
            item=bundle.title,
            family=bundle.scene.family,
            task=bundle.description,
            seed=rollouts.seed,
            labels=labels,
            state=rollouts.state[:length, world].copy(),
            action=rollouts.recorded_action[:length, world].copy(),
            success=np.arange(length) >= rollouts.held_at[world],
            simulated=rollouts.simulated(world, cfg.size_px),
            referee=bool(rollouts.referee[world]),
            objects=tuple(o.name for o in bundle.scene.objects),
            params=rollouts.params[world] | drawn,
            cameras=cfg.cameras,
            actions=rollouts.names,
            rgb_mp4=rgb_mp4,
        )

    def _pictures(
        self, rollouts: Rollouts, world: int, length: int, episode_id: str
    ) -> tuple[np.ndarray, bytes, dict[str, Any]]:
        course = list(rollouts.snapshots[:length])
        if self.is_plain:
            if self.renderer is None:
                self.renderer = self._renderer(self.bundle)
            return *self._drawn(self.renderer, [(s, world) for s in course]), {}
        rng = rng_for(rollouts.seed, "furnish", episode_id)
        scene = furnish(self.bundle, course, world, self.cfg.distractors, self.cfg.look, rng)
        with self._renderer(scene.world) as renderer:
            if len(scene.sizes):  # the last geoms; before the first picture, which fixes labels
                renderer.labels[-len(scene.sizes) :] = BACKGROUND
            moments = [(scene.moment(s, world), 0) for s in course]
            return *self._drawn(renderer, moments), scene.drawn

    def _renderer(self, source: TaskBundle | World) -> MaskRenderer:
        return MaskRenderer(
            source,
            self.cfg.size_px,
            num_threads=self.num_threads,
            wrist=WRIST_CAMERA in self.cfg.cameras,
        )

    def _drawn(
        self, renderer: MaskRenderer, moments: list[tuple[Snapshot, int]]
    ) -> tuple[np.ndarray, bytes]:
        labels = renderer.draw_many(moments)
        if self.cfg.render == "masks":
            return labels, b""
        pictures = np.stack([renderer.draw_rgb(*moment) for moment in moments])
        return labels, encoding.encode_rgb(pictures).mp4
