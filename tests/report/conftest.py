"""A run folder as the stages leave it, small and made by hand."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from v2p_data.episodes.staging import Episode
from v2p_data.geometry.camera import Camera
from v2p_data.pipeline.artifact import Record, write_record, write_rejects
from v2p_data.report.media import frames_uri
from v2p_data.scene.scene import Scene, SceneObject

sys.path.insert(0, str(Path(__file__).parent))  # browser.py beside the tests


class FakeRun:
    """Adds results to a run folder, each with its record last."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def folder(self, stage: str, item: str, fingerprint: str = "0a1b2c3d") -> Path:
        folder = self.root / stage / f"{item}-{fingerprint}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def record(self, folder: Path, *, seconds=12.0, time="2026-01-02T03:04:05Z", **more) -> Path:
        item, _, fingerprint = folder.name.rpartition("-")
        write_record(
            folder,
            Record(
                **{
                    "stage": folder.parent.name,
                    "item": item,
                    "version": 1,
                    "fingerprint": fingerprint,
                    "recipe": {},
                    "inputs": {},
                    "seconds": seconds,
                    "provenance": {
                        "time": time,
                        "machine": "Linux x86_64, 2 cores",
                        "python": "3.12.1",
                        "packages": {"mujoco": "4.0.0"},
                        "argv": ["v2p", "generate", "my videos"],
                        "commit": "",
                    },
                    **more,
                }
            ),
        )
        return folder

    def rejected(
        self, stage: str, item: str, reason: str, detail: str, value=None, **more
    ) -> Path:
        rejected = {"reason": reason, "detail": detail, "value": value}
        return self.record(self.folder(stage, item), rejected=rejected, **more)

    def scene(self, item: str, caption="Lifting a mug", **more) -> Path:
        folder = self.folder("scene", item)
        trimesh.creation.cylinder(0.04, 0.1).export(folder / "mug.obj")
        mug = SceneObject(
            name="mug",
            label="a mug",
            role="manipulated",
            shape="mesh",
            size_m=(0.08, 0.08, 0.1),
            mass_kg=0.25,
            friction=0.7,
            hollow=True,
            mesh="mug.obj",
            rgba=(0.8, 0.3, 0.2, 1.0),
            source={"size": "noun table: mug", "mass": "volume and density"},
            frames=(0, 30),
            poses_world=(
                (0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0),
                (0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0),
            ),
            confidences=(0.9, 0.81),
        )
        fields = {"title": item, "video": f"{item}.mp4", "description": caption, "kind": "lift_up"}
        Scene(
            **(fields | more),
            objects=(mug,),
            fps=24.0,
            num_frames=48,
            confidence=0.77,
            warnings=("a weak shadow",),
            camera=Camera(width_px=64, height_px=48, K=np.eye(3), T_world_cam=np.eye(4)),
        ).save(folder)
        (folder / "overlay.mp4").write_bytes(film())
        counts = {"kind": "lift_up", "objects": 1}
        return self.record(folder, counts=counts, recipe={"config": {"caption": caption}})

    def task(self, item: str, code="class LiftMug(Task):\n    ...\n", text="") -> Path:
        """`text` is put wherever a task's files hold free text."""
        folder = self.folder("task", item)
        (folder / "task.py").write_text(code)
        audit = {
            "score": 0.85,
            "checks": [
                {
                    "name": "reset",
                    "asks": text or "false at every reset?",
                    "passed": True,
                    "share": 0.0,
                },
                {
                    "name": "becomes_true",
                    "asks": "true after a plausible displacement?",
                    "passed": True,
                    "share": 0.071,
                },
                {
                    "name": "flung",
                    "asks": "false when it flies past?",
                    "passed": False,
                    "share": 0.25,
                },
            ],
        }
        samples = [
            {"runnable": False, "error": text or "NameError: mug", "score": 0.0, "audit": {}},
            {"runnable": True, "error": "", "score": 0.85, "audit": audit},
        ]
        (folder / "task.json").write_text(json.dumps({"kind": "lift_up", "audit": audit}))
        (folder / "audit.json").write_text(
            json.dumps(
                {
                    "picked": 1,
                    "writer": "vlm",
                    "model": "gpt-4o",
                    "pick": {"by": "audit"},
                    "samples": samples,
                }
            )
        )
        return self.record(folder, counts={"kind": "lift_up", "picked": 1}, seconds=3.0)

    def expert(self, item: str, rejected=None) -> Path:
        folder = self.folder("expert", item)
        steps = np.linspace(8e3, 2e6, 120)
        rise = 1 / (1 + np.exp(-(steps - 7e5) / 1.5e5))
        lines = [
            "steps,seconds,success_deterministic,success_stochastic,return,reward_reach,reward_lift"
        ]
        lines += [
            f"{s:.6g},{s / 2e4:.4g},{'nan' if k < 5 else f'{0.97 * r:.4g}'},"
            f"{0.8 * r:.4g},{5 * r:.4g},{0.3 * r:.4g},{r * r:.4g}"
            for k, (s, r) in enumerate(zip(steps, rise, strict=True))
        ]
        (folder / "curve.csv").write_text("\n".join(lines) + "\n2e6,100,0.9")
        sheet = np.full((200, 900, 3), 90, np.uint8)
        cv2.imwrite(str(folder / "sheet.png"), sheet)
        success = {"successes": 60, "trials": 64, "low": 0.85, "high": 0.975}
        return self.record(folder, counts={"success": success}, seconds=95.0, rejected=rejected)

    def episodes(self, item: str, count=3) -> Path:
        folder = self.folder("episodes", item)
        for k in range(count):
            episode(f"{item}_{k:04d}", item).save(folder / "episodes")
        write_rejects(
            folder,
            [
                {"id": "a", "reason": "not_successful", "detail": "the mug fell", "value": 0.25},
                {"id": "b", "reason": "not_successful", "detail": "out of time", "value": 0.5},
            ],
        )
        return self.record(
            folder, counts={"episodes": count, "frames": 60 * count, "rollouts": 5}, seconds=42.0
        )

    def dataset(self, item="demo") -> Path:
        counts = {"episodes": 3, "frames": 180, "repo_id": f"anna/{item}"}
        return self.record(self.folder("dataset", item), counts=counts, seconds=30.0)

    def policy(self, item="demo") -> Path:
        folder = self.folder("policy", item)
        (folder / "curve.csv").write_text("step,loss\n1,0.9\n100,0.3\n200,0.1\n")
        return self.record(
            folder, counts={"steps": 200, "final_loss": 0.1, "policy": "policy"}, seconds=400.0
        )

    def evaluation(self, rows, item="demo") -> Path:
        folder = self.folder("evaluation", item)
        for row in rows:
            videos = folder / "videos" / row["task"]
            videos.mkdir(parents=True, exist_ok=True)
            (videos / "episode_0.mp4").write_bytes(film())
        return self.record(folder, counts={"tasks": len(rows), "rows": rows}, seconds=200.0)

    def whole(self) -> "FakeRun":
        """Everything: one video through the whole chain, two that stop on the way, one held out."""
        self.scene("lift_mug")
        self.task("lift_mug")
        self.expert("lift_mug")
        self.episodes("lift_mug")
        self.rejected(
            "scene",
            "shaky",
            "camera_moves",
            "the camera moves by 31 px; hold it still",
            31.0,
            recipe={"config": {"caption": "Pushing a box to the left"}},
            seconds=1.5,
        )
        self.scene("tip_bottle", "Tipping a bottle over", kind="tip_over")
        self.task("tip_bottle")
        self.expert(
            "tip_bottle",
            {"reason": "expert_not_learned", "detail": "succeeds in 5 %", "value": 0.05},
        )
        self.scene("unseen_lift", "Lifting a tin")
        self.task("unseen_lift")
        self.dataset()
        self.policy()
        self.evaluation(
            [
                {
                    "task": "lift_mug",
                    "seen": True,
                    "successes": 15,
                    "trials": 20,
                    "low": 0.531,
                    "high": 0.888,
                },
                {
                    "task": "unseen_lift",
                    "seen": False,
                    "successes": 4,
                    "trials": 20,
                    "low": 0.081,
                    "high": 0.416,
                },
            ]
        )
        return self


def film() -> bytes:
    """Two seconds of a square that moves."""
    import base64

    frames = np.full((20, 48, 64, 3), 60, np.uint8)
    for t in range(20):
        frames[t, 20:30, t * 2 : t * 2 + 10] = (220, 120, 40)
    return base64.b64decode(frames_uri(frames, 10.0).split(",", 1)[1])


def episode(name: str, item: str, num_frames=40) -> Episode:
    labels = np.zeros((num_frames, 64, 64), np.uint8)
    for t in range(num_frames):
        labels[t, : 10 + t // 2, 28:36] = 1
        labels[t, 40:52, 26:38] = 2
    action = np.sin(np.linspace(0, 6, num_frames)[:, None] + np.arange(7)).astype(np.float32)
    return Episode(
        id=name,
        item=item,
        task="Lifting a mug",
        seed=1,
        labels=labels,
        action=action,
        objects=("mug",),
        state=np.zeros((num_frames, 11), np.float32),
        success=np.arange(num_frames) > 30,
        referee=True,
    )


@pytest.fixture(scope="session")
def new_run():
    """Return a function that starts a run in an empty folder."""

    def start(root: Path) -> FakeRun:
        root.mkdir()
        return FakeRun(root)

    return start


@pytest.fixture
def run(tmp_path, new_run) -> FakeRun:
    return new_run(tmp_path / "run")
