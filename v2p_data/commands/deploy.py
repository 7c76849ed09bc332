"""`v2p deploy`: a trained policy on a robot, from one click per object."""

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from v2p_data.cli import parse
from v2p_data.deployment.limits import LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Onlooker, Outcome, Run
from v2p_data.deployment.recording import Recorder, check_free
from v2p_data.deployment.rig import Rig
from v2p_data.deployment.robot import Reading, fingers_m
from v2p_data.deployment.segmentation import ColourTracker, StreamTracker
from v2p_data.deployment.sight import Sight, clicks_from
from v2p_data.deployment.silhouette import Silhouette
from v2p_data.errors import V2PError, did_you_mean
from v2p_data.geometry.camera import Camera
from v2p_data.sim.render.masks import PALETTE

ROBOT_PREFIX = "--robot."
CLICK_WAIT_S = 300.0
OURS = ("v2p_franka", "v2p_twin")
"""Robots that give masks unless they are asked for pictures."""


@dataclass(frozen=True, kw_only=True)
class Deploy:
    policy: tyro.conf.Positional[Path]
    """Folder of a LeRobot policy that sees masks. The robot is given by --robot.type=v2p_franka (or v2p_twin) and that
    robot's own settings, such as --robot.address=HOST:PORT."""
    click: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """X,Y: a pixel of the 256 x 256 picture on an object; once per object, the moved one first.
    Without it a page asks."""
    objects: tuple[str, ...] = ("object",)
    """What the page asks to click on, in order, and what the recording calls them."""
    task: str = ""
    """The task in words, as in the training's captions; by default what a simulated robot says."""
    record: Path | None = None
    """Where the run goes as a LeRobot dataset; must not exist. Without it nothing is kept."""
    repo_id: str = "v2p/deployed"
    """USER/NAME of the recording."""
    segmenter: Literal["colour", "sam2"] = "colour"
    """Who follows the objects: our tracker without weights, or SAM 2, which needs a GPU for 20 Hz."""
    segmenter_model: str = ""
    """`sam2`: Hub id or folder of the checkpoint."""
    device: Literal["cpu", "cuda", "mps"] = "cpu"
    """Where the policy and SAM 2 run."""
    loop: tyro.conf.OmitArgPrefixes[LoopConfig] = field(default_factory=LoopConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)


def deploy_command(argv: list[str]) -> int:
    robot_words, others = robot_settings(argv)
    args = parse(Deploy, others, "deploy")
    if args.record is not None:
        check_free(args.record)
    from v2p_data.commands.settings import check_device

    check_device(args.device)
    if args.repo_id.count("/") != 1:
        raise V2PError(f"--repo-id is USER/NAME, such as me/run_1; got '{args.repo_id}'")
    with connected(robot_words) as robot:
        outcome = deploy(args, robot)
    work = outcome.work_ms
    if work:
        print(  # noqa: T201
            f"{outcome.steps} steps, {outcome.mean_ms:.1f} ms of work each: up to {1000 / outcome.mean_ms:.0f} Hz"
        )
    if outcome.acted:
        counts = ", ".join(f"{name} {n}x" for name, n in outcome.acted.most_common())
        print(f"Limits that acted: {counts}")  # noqa: T201
    if outcome.went_well:
        print(f"Ended: {outcome.sentence}")  # noqa: T201
    if args.record is not None and args.record.is_dir():
        print(f"Made {args.record}\nNext: v2p verify {args.record}")  # noqa: T201
    if not outcome.went_well and outcome.ending != "interrupted":
        raise V2PError(outcome.sentence)
    if outcome.ending == "interrupted":
        print(f"Ended: {outcome.sentence}")  # noqa: T201
        return 130
    return 0


def deploy(args: Deploy, robot: Any) -> Outcome:
    """Check the policy, find the objects, run, and record.

    Raises:
        V2PError: anything that forbids to begin.
    """
    from v2p_data.deployment.checks import check_policy, unknowns
    from v2p_data.evaluation.facts import interface_of

    rig = Rig(robot, args.limits)
    reading = rig.read()
    picture = reading.picture if reading.picture is not None else reading.labels
    if picture is None:
        raise V2PError("the robot gives neither a picture nor a mask, so the policy cannot see")
    task = args.task or str(getattr(robot, "task_description", ""))
    height, width = picture.shape[:2]
    gives_joints = reading.joints_rad is not None
    facts = check_policy(args.policy, (height, width), rig.scale, task, gives_joints=gives_joints)
    if unknowns(facts):
        print(f"The policy does not say {unknowns(facts)}")  # noqa: T201
    policy = loaded_policy(args.policy, task, args.device)
    sight = None
    if reading.picture is not None:
        clicks = _clicks(args, robot.calibration(), reading)
        sight = Sight(robot.calibration(), clicks, _tracker_maker(args))
    elif args.click:
        raise V2PError("this robot segments by itself; leave --click away")
    num_labels = getattr(policy.loaded.policy.config, "num_labels", None)
    if sight is not None and num_labels is not None and len(sight.clicks_px) + 2 > num_labels:
        raise V2PError(
            f"{len(sight.clicks_px)} objects are clicked, and the policy was trained to tell "
            f"{num_labels - 2} apart; click"
            " on those of the task only"
        )
    recorder = None if args.record is None else Recorder(task)
    onlooker = Onlooker(
        recorder=recorder, is_done=lambda: bool(getattr(robot, "has_succeeded", False))
    )
    interface, *_ = interface_of(args.policy)
    outcome = Run(Rig(robot, args.limits, sight, interface), policy, args.loop, onlooker).go()
    if args.record is not None and recorder is not None:
        _record(args, recorder, sight, outcome)
    return outcome


def _record(args: Deploy, recorder: Any, sight: Any, outcome: Outcome) -> None:
    """Write what was seen and done; a failure to do so does not hide how the run went."""
    assert args.record is not None
    count = len(sight.clicks_px) if sight is not None else 0
    names = (*args.objects[:count], *(f"object_{k + 1}" for k in range(len(args.objects), count)))
    about = {
        "policy": str(args.policy),
        "clicks_px": [list(click) for click in sight.clicks_px] if sight is not None else [],
        "ending": outcome.ending,
        "sentence": outcome.sentence,
        "dry_run": args.loop.dry_run,
        "limits": asdict(args.limits),
        "mean_step_ms": round(outcome.mean_ms, 2),
    }
    try:
        if recorder.save(args.record, args.repo_id, tuple(names), about) is None:
            print("Nothing was recorded: the run ended before its second step")  # noqa: T201
    except V2PError as error:
        outcome.sentence += f". The recording failed: {error}"
        outcome.ending = "robot" if outcome.went_well else outcome.ending


def robot_settings(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words that set up the robot, as LeRobot's own tools take them, and the others."""
    robot, others = [], []
    words = iter(argv)
    for word in words:
        if not word.startswith(ROBOT_PREFIX):
            others.append(word)
        elif "=" in word:
            robot.append(word)
        else:
            robot.append(f"{word}={next(words, '')}")
    return robot, others


@contextlib.contextmanager
def connected(words: Sequence[str]) -> Iterator[Any]:
    """Yield the robot that the settings describe, connected; in the end it is disconnected.

    Raises:
        V2PError: there is no such robot, a setting is wrong, or it does not answer.
    """
    from lerobot.robots import make_robot_from_config

    named = {
        word.partition("=")[0].removeprefix(ROBOT_PREFIX): word.partition("=")[2] for word in words
    }
    gives_pictures = named.get("type") in OURS and named.get("backend") != "franky"
    if gives_pictures and not {"pictures", "clicks"} & set(named):
        words = [*words, f"{ROBOT_PREFIX}pictures=rgb"]
    config = robot_config(words)
    robot = make_robot_from_config(config)
    robot.connect()
    try:
        yield robot
    finally:
        robot.disconnect()


def robot_config(words: Sequence[str]) -> Any:
    """Return LeRobot's settings of a robot.

    Raises:
        V2PError: a setting is wrong.
    """
    import draccus
    from lerobot.robots import RobotConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    import lerobot_policy_v2p  # noqa: F401 - registers our robots where the package is not installed

    known = sorted(RobotConfig.get_known_choices())
    named = [w.partition("=")[2] for w in words if w.startswith("--robot.type=")]
    if not named:
        raise V2PError(
            "say which robot: --robot.type=v2p_franka with --robot.address=HOST:PORT for a driver, or with"
            " --robot.task_folder=TASK for the simulated arm"
        )
    if named[-1] not in known:
        raise V2PError(f"there is no robot '{named[-1]}'.{did_you_mean(named[-1], known)}")
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            # LeRobot's parser takes no choice by itself.
            holder = make_dataclass("Holder", [("robot", RobotConfig)])
            return draccus.parse(holder, args=list(words)).robot
    except SystemExit as error:
        wrong = " ".join(told.getvalue().rpartition("error:")[2].split())
        raise V2PError(f"the robot's settings are wrong: {wrong}") from error
    except Exception as error:
        cause = error.__cause__ or error.__context__ or error
        reason = str(cause if isinstance(cause, ValueError) else error)
        raise V2PError(
            f"the robot's settings are wrong: {reason.strip().splitlines()[0]}"
        ) from error


def loaded_policy(folder: Path, task: str, device: str) -> Any:
    """Return a policy that acts, checked by `check_policy` before.

    Raises:
        V2PError: LeRobot cannot load it, or it needs to be told the task.
    """
    from policies.evaluation.actor import UnsuitablePolicyError, load_actor
    from v2p_data.evaluation.facts import interface_of

    try:
        _, num_states, num_actions = interface_of(folder)
        actor = load_actor(
            folder,
            greys=PALETTE,
            task=task,
            device=device,
            num_states=num_states,
            num_actions=num_actions,
        )
    except UnsuitablePolicyError as error:
        raise V2PError(str(error)) from error
    if getattr(actor.loaded.policy.config, "use_task", False) and not task:
        raise V2PError("the policy needs the task in words: --task 'Lifting red box up'")
    return actor


def _clicks(args: Deploy, camera: Camera, reading: Reading) -> Sequence[tuple[float, float]]:
    """Return a pixel per object, from the command line or from the page."""
    from v2p_data.deployment.click_page import ClickPage

    if args.click:
        return clicks_from(args.click)
    assert reading.picture is not None
    assert reading.joints_rad is not None
    drawn = Silhouette(camera).draw(reading.joints_rad, fingers_m(reading.opening))
    new_tracker, shown = _tracker_maker(args), reading.picture
    with ClickPage(
        shown, args.objects, lambda click: new_tracker().start(shown, click, drawn)
    ) as page:
        print(f"Click on {', '.join(args.objects)} at {page.address}", flush=True)  # noqa: T201
        return page.wait(CLICK_WAIT_S)


def _tracker_maker(args: Deploy) -> Callable[[], StreamTracker]:
    if args.segmenter == "colour":
        return ColourTracker
    from v2p_data.deployment.sam2_stream import Sam2Tracker
    from v2p_data.scene.backends.config import SegmentConfig

    cfg = SegmentConfig(backend="sam2", model=args.segmenter_model, device=args.device)
    return lambda: Sam2Tracker(cfg)
