"""Workers here are real processes: the example of scripts/, and short programs that break the contract."""

import io
import json
import os
import shlex
import sys
import textwrap
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.geometry.camera import intrinsics
from v2p_data.scene.backends.config import DepthConfig, GroundConfig, SegmentConfig
from v2p_data.scene.backends.depth import predict_depth, table_from_depth
from v2p_data.scene.backends.detect import detect
from v2p_data.scene.backends.segment import Prompt, segment_video
from v2p_data.scene.backends.worker import WorkerRequest, run_worker

EXAMPLE = shlex.join(
    [sys.executable, str(Path(__file__).parents[3] / "scripts/example_worker.py")]
)


@pytest.fixture
def worker(tmp_path):
    """Return the command line of a worker with this body: `given` and `out` are there, `answer` writes."""

    def command(body: str) -> str:
        path = tmp_path / "worker with a space.py"
        path.write_text(
            textwrap.dedent(
                """
                import json, os, sys, time
                from pathlib import Path
                given, out = Path(sys.argv[2]), Path(sys.argv[4])
                assert (sys.argv[1], sys.argv[3]) == ("--request", "--result")
                def answer(kind, fields=None, version=1, **arrays):
                    import numpy as np
                    np.savez(out / "result.npz", **arrays)
                    head = {"schema": "v2p-worker", "version": version, "kind": kind}
                    (out / "result.json").write_text(json.dumps({**head, "fields": fields or {}}))
                """
            )
            + textwrap.dedent(body)
        )
        return shlex.join(
            [sys.executable, "-S", str(path)]
            if "numpy" not in body
            else [sys.executable, str(path)]
        )

    return command


def depth_request(n: int = 1, h: int = 6, w: int = 8) -> WorkerRequest:
    return WorkerRequest(kind="depth", arrays={"images": np.zeros((n, h, w, 3), np.uint8)})


def mesh_request(mask: np.ndarray) -> WorkerRequest:
    image = np.zeros((*mask.shape, 3), np.uint8)
    return WorkerRequest(
        kind="mesh", arrays={"image": image, "mask": mask}, fields={"name": "cup"}
    )


def refusal(command: str, request: WorkerRequest, **limits) -> str:
    with pytest.raises(V2PError) as caught:
        run_worker(command, request, limits.pop("timeout_s", 30.0), **limits)
    return str(caught.value)


def test_the_example_worker_makes_a_closed_mesh_with_the_outlines_proportions():
    mask = np.zeros((120, 160), bool)
    mask[20:100, 40:80] = True  # twice as high as wide

    result = run_worker(EXAMPLE, mesh_request(mask), 60.0)

    assert result.mesh is not None
    assert result.mesh.is_watertight
    assert result.mesh.volume > 0
    assert result.repair == "none"
    assert result.fields["metric"] is False
    assert result.mesh.extents[2] / result.mesh.extents[1] == pytest.approx(2, rel=0.05)


def test_the_example_workers_depth_gives_back_its_camera(picture):
    cfg = DepthConfig(backend="worker", worker=EXAMPLE, worker_timeout_s=60.0)

    depth = predict_depth([picture, picture], cfg)

    # The example says: 0.5 m high, 0.61 rad down, 1.01 rad wide.
    assert depth.fov_rad == pytest.approx([1.01, 1.01])
    K = intrinsics(64, 48, float(2 * np.arctan(np.tan(1.01 / 2) * 48 / 64)))
    plane = table_from_depth(depth.depth_m[1], K, rng=np.random.default_rng(0))
    assert plane is not None
    assert plane.height_m == pytest.approx(0.5, abs=1e-6)
    assert plane.pitch_rad == pytest.approx(0.61, abs=1e-6)


def test_the_example_worker_refuses_what_it_cannot_do_with_its_own_sentence():
    with pytest.raises(ItemRejectedError, match="too few for a shape") as caught:
        run_worker(EXAMPLE, mesh_request(np.zeros((20, 20), bool)), 60.0)

    assert caught.value.reason == "worker_refused"


def test_a_kind_that_a_worker_does_not_do_is_said_with_its_last_words():
    request = WorkerRequest(
        kind="ground",
        arrays={"images": np.zeros((1, 4, 4, 3), np.uint8)},
        fields={"phrases": ["a"]},
    )

    said = refusal(EXAMPLE, request)

    assert "exit code 2" in said
    assert "this worker does ['depth', 'mesh']" in said


def test_a_hanging_worker_is_killed_with_all_that_it_started(worker, tmp_path):
    command = worker(
        f"""
        import signal, subprocess
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        child = subprocess.Popen(["sleep", "600"])
        Path({str(tmp_path)!r}, "child").write_text(str(child.pid))
        print("still loading", flush=True)
        time.sleep(600)
        """
    )

    said = refusal(command, depth_request(), timeout_s=1.5)

    assert "stopped after 1.5 s" in said
    assert "still loading" in said
    child = int((tmp_path / "child").read_text())
    # Killed, if perhaps not yet collected by its new parent.
    state = Path(f"/proc/{child}/stat")
    assert not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z"


def test_what_a_worker_started_in_a_session_of_its_own_is_killed_with_it(worker, tmp_path):
    command = worker(
        f"""
        import subprocess
        child = subprocess.Popen(["sleep", "600"], start_new_session=True)
        Path({str(tmp_path)!r}, "child").write_text(str(child.pid))
        sys.exit(1)
        """
    )

    refusal(command, depth_request())

    state = Path(f"/proc/{int((tmp_path / 'child').read_text())}/stat")
    assert not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z"


def test_a_workers_words_give_a_terminal_no_orders(worker):
    words = "\x1b[2Jone\r\ntwo\x9b"
    last = refusal(worker(f"sys.exit({words!r})"), depth_request())
    body = f"(out / 'result.json').write_text(json.dumps({{'message': {words!r}}}))\nsys.exit(3)"
    said = refusal(worker(body), depth_request())

    assert last.endswith("it last said: \\x1b[2Jone two\\x9b")
    assert said.endswith("refuses the item: \\x1b[2Jone two\\x9b")


def test_a_crashing_workers_last_words_are_in_the_error(worker):
    said = refusal(worker("raise MemoryError('CUDA out of memory')"), depth_request())

    assert "exit code 1" in said
    assert said.endswith("CUDA out of memory")


def test_a_killed_worker_names_the_signal(worker):
    assert "signal 9" in refusal(worker("os.kill(os.getpid(), 9)"), depth_request())


def test_a_command_that_is_not_there_is_a_clear_error():
    assert "cannot be started" in refusal("no-such-program --flag", depth_request())


def test_a_worker_that_fills_the_disk_is_stopped(worker):
    command = worker(
        """
        with (out / "result.npz").open("wb") as file:
            while True:
                file.write(bytes(100_000)); file.flush()
        """
    )

    assert "more than 3000000 bytes" in refusal(command, depth_request(), max_bytes=3_000_000)


def test_a_result_that_is_too_large_on_paper_is_not_opened(worker):
    head = {"schema": "v2p-worker", "version": 1, "kind": "depth", "fields": METRIC}
    command = worker(
        f"""
        (out / "result.json").write_text({json.dumps(head)!r})
        (out / "result.npz").touch()
        os.truncate(out / "result.npz", 10**11)  # takes no room on the disk
        """
    )

    assert "larger than" in refusal(command, depth_request())


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("pass", "wrote no result.json"),
        ("(out / 'result.json').write_text('{')", "no JSON"),
        ("(out / 'result.json').write_text('[' * 100000)", "no JSON"),
        ("(out / 'result.json').write_bytes(bytes([255, 254]))", "no JSON"),
        ("(out / 'result.json').write_text('[]')", "one JSON object"),
        ("(out / 'result.json').write_text(' ' * 2**21)", "larger than"),
        ("(out / 'result.json').symlink_to('/etc/hostname')", "no plain file"),
        ("os.mkfifo(out / 'result.json')", "no plain file"),
    ],
)
def test_a_bad_result_json_is_refused(worker, body, said):
    assert said in refusal(worker(body), depth_request())


def npz(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def claims_a_terabyte() -> bytes:
    header, file = io.BytesIO(), io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
    np.lib.format.write_array_header_1_0(header, shape)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("depth_m.npy", header.getvalue())
    return file.getvalue()


GOOD = np.ones((1, 6, 8))
METRIC = {"metric": True}


@pytest.mark.parametrize(
    ("kind", "version", "fields", "file", "said"),
    [
        ("mesh", 1, METRIC, npz(depth_m=GOOD), "('v2p-worker', 1, 'mesh'), but"),
        ("depth", 2, METRIC, npz(depth_m=GOOD), "('v2p-worker', 2, 'depth'), but"),
        ("depth", 1, {}, npz(depth_m=GOOD), "field 'metric'"),
        ("depth", 1, {"metric": 1}, npz(depth_m=GOOD), "field 'metric'"),
        ("depth", 1, [], npz(depth_m=GOOD), "must be an object"),
        ("depth", 1, METRIC, None, "wrote no result.npz"),
        ("depth", 1, METRIC, npz(), "lacks the array 'depth_m'"),
        ("depth", 1, METRIC, npz(depth_m=np.ones((1, 8, 6))), "got float64 [1, 8, 6]"),
        ("depth", 1, METRIC, npz(depth_m=np.ones((2, 6, 8))), "got float64 [2, 6, 8]"),
        ("depth", 1, METRIC, npz(depth_m=np.ones((1, 6, 8), int)), "got int64"),
        ("depth", 1, METRIC, npz(depth_m=-GOOD), "0..10000"),
        ("depth", 1, METRIC, npz(depth_m=np.inf * GOOD), "finite"),
        ("depth", 1, METRIC, npz(depth_m=GOOD, fov_rad=np.array([np.nan])), "1 NaN"),
        ("depth", 1, METRIC, npz(depth_m=np.array([{}], object)), "Python objects"),
        ("depth", 1, METRIC, npz(depth_m=GOOD.astype(np.longdouble)), "got float128"),
        (
            "depth",
            1,
            METRIC,
            npz(depth_m=GOOD, more=GOOD),
            "an array 'more' that nobody asked for",
        ),
        ("depth", 1, METRIC, b"PK garbage", "as npz"),
        ("depth", 1, METRIC, npz(depth_m=GOOD)[:-40], "as npz"),
        ("depth", 1, METRIC, claims_a_terabyte(), "cut off"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_answer_that_breaks_the_contract_is_refused(
    worker, tmp_path, kind, version, fields, file, said
):
    head = {"schema": "v2p-worker", "version": version, "kind": kind, "fields": fields}
    if file is not None:
        (tmp_path / "prepared").write_bytes(file)
    command = worker(
        f"""
        import shutil
        (out / "result.json").write_text({json.dumps(head)!r})
        if {file is not None}:
            shutil.copy({str(tmp_path / "prepared")!r}, out / "result.npz")
        """
    )

    assert said in refusal(command, depth_request())


def test_nan_in_depth_says_that_there_is_none(worker, picture):
    command = worker(
        """
        import numpy as np
        depth = np.ones((1, 48, 64)); depth[0, 0, 0] = np.nan
        answer("depth", {"metric": True}, depth_m=depth.astype("f4"))
        """
    )

    depth = predict_depth([picture], DepthConfig(backend="worker", worker=command)).depth_m

    assert np.isnan(depth[0, 0, 0])
    assert np.isfinite(depth).sum() == depth.size - 1


def mesh_worker(worker, text: str) -> str:
    return worker(
        f'answer_text = {text!r}\n(out / "mesh.obj").write_text(answer_text)\n' + MESH_HEAD
    )


MESH_HEAD = """(out / "result.json").write_text(json.dumps(
    {"schema": "v2p-worker", "version": 1, "kind": "mesh", "fields": {"metric": True}}))
"""
BOX = trimesh.creation.box((0.1, 0.2, 0.3))


def obj(vertices, faces) -> str:
    lines = ["v {} {} {}".format(*v) for v in vertices]
    return "\n".join(lines + ["f {} {} {}".format(*(f + 1)) for f in faces])


def test_a_mesh_with_a_missing_triangle_is_closed_and_one_turned_inside_out_is_turned_back(worker):
    mask = np.ones((4, 4), bool)

    holed = run_worker(
        mesh_worker(worker, obj(BOX.vertices, BOX.faces[1:])), mesh_request(mask), 30.0
    )
    turned = run_worker(
        mesh_worker(worker, obj(BOX.vertices, BOX.faces[:, ::-1])), mesh_request(mask), 30.0
    )

    for result, repair in ((holed, "holes_filled"), (turned, "none")):
        assert result.mesh is not None
        assert result.mesh.is_watertight
        assert result.mesh.volume == pytest.approx(0.1 * 0.2 * 0.3)
        assert result.repair == repair


@pytest.mark.parametrize("grouped", [True, False])
def test_closed_pieces_that_share_an_edge_are_no_mesh_with_holes(worker, grouped):
    second = BOX.vertices + np.array([0.1, 0.2, 0])
    one, other = obj(BOX.vertices, BOX.faces), obj(second, BOX.faces + 8)
    text = obj(np.concatenate([BOX.vertices, second]), np.concatenate([BOX.faces, BOX.faces + 8]))
    text = f"o a\n{one}\no b\n{other}" if grouped else text

    result = run_worker(mesh_worker(worker, text), mesh_request(np.ones((4, 4), bool)), 30.0)

    assert result.mesh is not None
    assert result.repair == "none"
    assert result.mesh.volume == pytest.approx(2 * 0.1 * 0.2 * 0.3)


def test_a_mesh_that_is_mostly_holes_becomes_its_convex_hull(worker):
    ring = BOX.faces[np.abs(BOX.face_normals[:, 2]) < 0.5][::2]

    result = run_worker(
        mesh_worker(worker, obj(BOX.vertices, ring)), mesh_request(np.ones((4, 4), bool)), 30.0
    )

    assert result.repair == "convex_hull"
    assert result.mesh is not None
    assert result.mesh.is_watertight


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "mesh.obj"),
        ("v 0 0 0\nf 1 2 9\n", "mesh.obj"),
        (obj(BOX.vertices * [1, 1, 0], BOX.faces), "flat"),
        (obj(BOX.vertices * np.nan, BOX.faces), "not numbers"),
        ("mtllib ../../../etc/passwd\nusemtl x\nnot an obj", "mesh.obj"),
    ],
)
def test_a_mesh_that_is_none_is_refused(worker, text, said):
    assert said in refusal(mesh_worker(worker, text), mesh_request(np.ones((4, 4), bool)))


def test_poses_must_be_rigid(worker):
    request = WorkerRequest(
        kind="pose",
        arrays={
            "images": np.zeros((2, 4, 4, 3), np.uint8),
            "masks": np.ones((2, 4, 4), bool),
            "K": np.eye(3),
            "mesh_vertices": np.array(BOX.vertices),
            "mesh_faces": np.array(BOX.faces),
        },
    )
    body = """
    import numpy as np
    T = np.stack([np.eye(4)] * 2); T[1, 2, 2] = {}
    answer("pose", T_cam_objs=T, confidences=np.ones(2))
    """

    mirrored = refusal(worker(body.format(-1)), request)
    scaled = refusal(worker(body.format(1.1)), request)
    kept = run_worker(worker(body.format(1)), request, 30.0)

    assert "rotations" in mirrored
    assert "rotations" in scaled
    np.testing.assert_array_equal(kept.arrays["T_cam_objs"][1], np.eye(4))


def test_a_worker_can_ground_and_segment(worker, picture):
    ground = worker(
        """
        import numpy as np
        phrases = json.loads((given / "request.json").read_text())["fields"]["phrases"]
        images = np.load(given / "arrays.npz")["images"]
        red = np.argwhere((images[1].astype(int) @ [1, -1, 0]) > 100)
        box = [*red.min(0)[::-1], *(red.max(0)[::-1] + 1)]
        answer("ground", boxes_xyxy=np.array([box], float), scores=np.array([0.9]),
               image_idx=np.array([1]), phrase_idx=np.array([phrases.index("red box")]))
        """
    )
    blank = np.full_like(picture, 200)

    found = detect(
        [blank, picture], ["cup", "red box"], GroundConfig(backend="worker", worker=ground)
    )

    assert found[0] == [[], []]
    assert found[1][0] == []
    assert [d.box_xyxy for d in found[1][1]] == [(6, 20, 22, 36)]

    segment = worker(
        """
        import numpy as np
        arrays = np.load(given / "arrays.npz")
        masks = np.zeros((1, *arrays["images"].shape[:3]), bool)
        left, top, right, bottom = arrays["boxes_xyxy"][0].astype(int)
        masks[0, arrays["frame_idx"][0], top:bottom, left:right] = True
        answer("segment", masks=masks, scores=np.ones(masks.shape[:2]))
        """
    )
    mask = np.zeros(picture.shape[:2], bool)
    mask[22:30, 8:20] = True
    prompt = Prompt(frame_idx=1, mask=mask)
    followed = segment_video(
        np.stack([picture] * 3), [prompt], SegmentConfig(backend="worker", worker=segment)
    )

    assert followed.masks.sum((2, 3)).tolist() == [[0, 12 * 8, 0]]


def test_a_request_that_breaks_the_contract_never_starts_the_worker(worker, tmp_path):
    command = worker(f"Path({str(tmp_path)!r}, 'started').touch()")
    images = np.zeros((1, 4, 4, 3), np.uint8)

    for arrays, said in [
        ({}, "lacks the array 'images'"),
        ({"images": images.astype(float)}, "must be uint8"),
        ({"images": images, "K": np.full((3, 3), np.nan)}, "NaN"),
        ({"images": images, "k": np.eye(3)}, "no array 'k'"),
    ]:
        assert said in refusal(command, WorkerRequest(kind="depth", arrays=arrays))
    assert not (tmp_path / "started").exists()


def test_the_request_on_disk_says_what_the_arrays_are_and_nothing_stays_behind(worker, tmp_path):
    command = worker(
        f"""
        import shutil
        shutil.copytree(given, {str(tmp_path / "seen")!r})
        Path({str(tmp_path / "where")!r}).write_text(str(given.parent))
        """
    )

    refusal(command, depth_request(n=2))

    head = json.loads((tmp_path / "seen/request.json").read_text())
    assert head == {
        "schema": "v2p-worker",
        "version": 1,
        "kind": "depth",
        "fields": {},
        "arrays": {"images": {"shape": [2, 6, 8, 3], "dtype": "uint8"}},
    }
    with np.load(tmp_path / "seen/arrays.npz", allow_pickle=False) as file:
        assert file["images"].shape == (2, 6, 8, 3)
    assert not os.path.lexists((tmp_path / "where").read_text())
