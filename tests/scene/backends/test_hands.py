"""Hands from a worker: the contract, the environment of MediaPipe, and what the track of fingertips says."""

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.scene.backends import hands_setup
from v2p_data.scene.backends.config import HandsConfig
from v2p_data.scene.backends.worker import WorkerRequest, run_worker
from v2p_data.scene.frames.hand_track import HandTrack, contact_share, people_face
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.by_model import track_hands

HAND_M = np.random.default_rng(3).normal(0, 0.03, (21, 3))
"""Any 21 points of the size of a hand will do: [m], axes right, down, forward."""


def worker_of(body: str, folder: Path) -> str:
    """Return the command line of a worker with this body."""
    path = folder / "worker.py"
    path.write_text(
        "import json, sys\nfrom pathlib import Path\nimport numpy as np\n"
        "given, out = Path(sys.argv[2]), Path(sys.argv[4])\n"
        "images = np.load(given / 'arrays.npz')['images']\n"
        f"{body}\n"
        "np.savez(out / 'result.npz', **answer)\n"
        "(out / 'result.json').write_text(json.dumps({'schema': 'v2p-worker', 'version': 1, "
        "'kind': 'hands', 'fields': {}}))\n"
    )
    return shlex.join([sys.executable, str(path)])


ONE_HAND = """
n = len(images)
answer = dict(image_idx=np.arange(n), landmarks_px=np.full((n, 21, 2), 20.0), landmarks_m=np.zeros((n, 21, 3)),
              scores=np.full(n, 0.9), is_right=np.ones(n, bool))
"""


def track(num: int, px: np.ndarray, sampled: int | None = None) -> HandTrack:
    """Return one hand per frame."""
    return HandTrack(
        at=np.arange(num),
        px=px,
        metres=np.repeat(HAND_M[None], num, 0),
        num_sampled=sampled or num,
    )


def test_a_worker_s_hands_belong_to_working_frames_and_pixels(tmp_path, draw):
    clip = draw(num_frames=12)
    working = working_clip_of(clip)
    cfg = HandsConfig(backend="worker", worker=worker_of(ONE_HAND, tmp_path))

    hands = track_hands(clip, working, cfg)

    assert hands is not None
    assert hands.is_known
    np.testing.assert_array_equal(hands.at, np.arange(len(working.rgb)))
    np.testing.assert_allclose(hands.px, 20.0 * working.px_scale)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ("answer['image_idx'] += len(images)", "'image_idx' of result.npz must"),
        ("answer['scores'] += 1", "'scores' of result.npz must lie in 0..1"),
        ("answer['landmarks_m'] += 2", "'landmarks_m' of result.npz must lie in -1..1"),
        (
            "answer['landmarks_px'] = answer['landmarks_px'][:, :20]",
            "'landmarks_px' of result.npz must be float",
        ),
        ("del answer['is_right']", "lacks the array 'is_right'"),
    ],
)
def test_a_result_that_breaks_the_contract_is_one_sentence(tmp_path, wrong: str, sentence: str):
    command = worker_of(ONE_HAND + wrong, tmp_path)
    images = np.zeros((2, 24, 32, 3), np.uint8)

    with pytest.raises(V2PError, match=sentence.replace(".", r"\.")):
        run_worker(command, WorkerRequest(kind="hands", arrays={"images": images}), 60.0)


def test_a_picture_without_hands_is_an_answer(tmp_path, draw):
    body = ONE_HAND + "answer = {name: array[:0] for name, array in answer.items()}"
    clip = draw(num_frames=12)

    hands = track_hands(
        clip,
        working_clip_of(clip),
        HandsConfig(backend="worker", worker=worker_of(body, tmp_path)),
    )

    assert hands is not None
    assert len(hands.at) == 0
    assert not hands.is_known


@pytest.mark.usefixtures("cache")
def test_a_half_made_environment_is_not_used():
    hands_setup.hands_folder().mkdir(parents=True)

    assert hands_setup.installed_worker() == ""


@pytest.mark.usefixtures("cache")
def test_an_installation_that_fails_is_one_sentence_and_leaves_nothing_in_use(
    tmp_path, monkeypatch: pytest.MonkeyPatch
):
    lock = tmp_path / "requirements.lock"
    lock.write_text("no-such-package==1 --hash=sha256:" + 64 * "0" + "\n")
    monkeypatch.setattr(hands_setup, "REQUIREMENTS", lock)
    monkeypatch.setenv("UV_OFFLINE", "1")
    monkeypatch.setenv("PIP_NO_INDEX", "1")

    with pytest.raises(V2PError, match="without the hands worker everything works as before"):
        hands_setup.set_up_hands(lambda words: None)

    assert hands_setup.installed_worker() == ""


def test_the_real_worker_finds_no_hand_in_an_empty_picture(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("V2P_CACHE")
    command = hands_setup.installed_worker()
    if not command:
        pytest.skip("MediaPipe is not set up here: v2p setup hands")
    images = np.full((3, 120, 160, 3), 127, np.uint8)

    answer = run_worker(command, WorkerRequest(kind="hands", arrays={"images": images}), 120.0)

    assert answer.arrays["landmarks_px"].shape == (0, 21, 2)


def test_a_hand_that_goes_along_touches_and_one_that_stays_away_does_not():
    masks = np.zeros((10, 60, 80), bool)
    for i in range(10):
        masks[i, 30:40, 5 * i : 5 * i + 10] = True
    moving = np.arange(2, 8)
    beside = np.stack([np.tile([5.0 * i + 12, 35.0], (21, 1)) for i in range(10)])
    beside[:, 0] += [0, -15]  # the wrist, so that a palm is 15 px long
    away = np.tile([70.0, 5.0], (10, 21, 1))
    away[:, 0] += [0, 15]

    assert contact_share(track(10, beside), masks, moving) == 1.0
    assert contact_share(track(10, away), masks, moving) == 0.0
    assert contact_share(track(10, away, sampled=30), masks, moving) is None
    assert contact_share(None, masks, moving) is None


def pointing(way: tuple[float, float], at: tuple[float, float]) -> np.ndarray:
    """Return a hand's landmarks [px] with its wrist at a spot and its palm along a way."""
    reach = np.linspace(0, 1, 21)[:, None]
    px = np.array(at) + 60 * reach * way
    px[9] = np.array(at) + 30 * np.array(way)
    return px


@pytest.mark.parametrize(
    ("other", "at", "frames", "two"),
    [
        ((0.0, 1.0), (200.0, 20.0), 20, True),  # from the far side of the table
        ((-0.2, -1.0), (250.0, 200.0), 20, False),  # the same person's other hand
        ((-1.0, 0.1), (300.0, 120.0), 20, False),  # the other hand, from the side
        ((0.0, 1.0), (100.0, 150.0), 20, False),  # at the same place: found twice
        ((0.0, 1.0), (200.0, 20.0), 4, False),  # hardly ever
    ],
)
def test_hands_that_face_each_other_are_two_people_s(other, at, frames, two):
    own = np.repeat(pointing((0.1, -1.0), (100.0, 200.0))[None], 40, 0)
    second = np.repeat(pointing(other, at)[None], frames, 0)
    px, when = np.concatenate([own, second]), np.concatenate([np.arange(40), np.arange(frames)])
    order = np.argsort(when, kind="stable")
    hands = HandTrack(
        at=when[order], px=px[order], metres=np.repeat(HAND_M[None], len(px), 0), num_sampled=40
    )

    assert people_face(hands) is two


def test_nothing_is_said_of_two_people_where_no_model_knows_hands():
    assert people_face(None) is False
