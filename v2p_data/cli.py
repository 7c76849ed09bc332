"""The `v2p` command: parse, call, print what was made, the number that matters and the next command.

Only light modules are imported here, so that `v2p --help` answers at once; each command imports what it needs.
"""

import contextlib
import difflib
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from v2p_data.errors import NOT_ALL, NOTHING, NotAllError, V2PError, did_you_mean, write_refusal

COMMANDS: dict[str, tuple[str, str]] = {
    "generate": (
        "run",
        "a folder of videos becomes simulated tasks, experts and a LeRobot dataset",
    ),
    "distill": ("run", "a student acts, the experts label and take over: more episodes"),
    "train": ("run", "a dataset becomes a policy, by distillation where its experts are at hand"),
    "eval": ("run", "roll a policy out on tasks, seen and unseen, and give rates with intervals"),
    "deploy": ("deploy", "run a policy on a robot, from one click per object, within limits"),
    "push": ("share", "push a dataset, a policy or tasks (--envhub) to the Hub"),
    "scene": ("run", "videos -> scenes only: objects, meshes, sizes, poses"),
    "task": ("run", "up to the task code and its audit"),
    "reward": ("reward", "up to the rewards: rounds of them, trained against each other"),
    "expert": ("run", "up to the trained experts"),
    "episodes": ("run", "up to the episodes, without packing them"),
    "verify": ("share", "reopen a dataset with LeRobot and check every frame"),
    "replay": (
        "share",
        "play a dataset's episodes again from seeds and actions: does the same come back?",
    ),
    "explain": ("share", "where a dataset, an episode or a result comes from, or how two differ"),
    "merge": ("edit", "several datasets become one"),
    "drop": ("edit", "a dataset without some of its tasks"),
    "status": ("show", "what a run folder holds, and what failed and why"),
    "report": ("show", "write a run's page again"),
    "gc": ("gc", "what can be deleted of a run folder, and what making it again would cost"),
    "demo": ("run", "the whole chain on three sample clips"),
}
"""Command -> module of `v2p_data.commands` that holds it, and what it does."""
SUBCOMMANDS: dict[str, tuple[str, str]] = {
    "scene camera": ("camera", "what all scenes of a run say of the one camera that filmed them"),
    "scene detectors": (
        "models",
        "whether everyday things are known by sight here, and the model's download",
    ),
    "scene hands": ("models", "whether hands are found by a model here, and its installation"),
    "scene models": ("models", "which learned models a preset takes here, and their download"),
    "scene outlines": (
        "models",
        "whether objects are outlined by a model here, and its download",
    ),
    "scene review": ("review", "a page to judge a run's scenes on and to mark what was not found"),
    "task show": ("task", "a task's code, and the audit's answers"),
    "reward search": ("reward", "search for one task's reward"),
    "reward show": ("reward", "what a search tried, with curves, analysis and differences"),
}
"""The same for commands of two words; a folder of the second word's name is given as `./review`."""
EXIT_CODES = {
    0: "made; videos that were rejected are listed, with reasons",
    1: "a check found something wrong (verify, status --check)",
    NOTHING: "not made, or not begun; one sentence says why",
    NOT_ALL: "made, but not all: something failed or is damaged, and the same command goes on with it",
    130: "stopped by Ctrl-C",
}
"""Exit code -> what it means."""


def main() -> None:
    """Run the command line; bad input ends with one sentence and an exit code of `EXIT_CODES`."""
    # Read when torch is loaded, here and in worker processes. Threads that wait by spinning made training on two cores
    # ten times slower beside another job.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Ninety lines on FFmpeg versions that say what setup says in one.
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
    # The Ctrl-C of a pipe's reader (`v2p status | head`) is no error of ours.
    try:
        sys.exit(run(sys.argv[1:]))
    except BrokenPipeError:
        os._exit(0)


def run(argv: Sequence[str]) -> int:
    """Return the exit code of `v2p` with these arguments."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_help())
        return 0
    if argv[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(f"v2p {version('lerobot_policy_v2p')}")
        return 0
    name = " ".join(argv[:2]) if " ".join(argv[:2]) in SUBCOMMANDS else argv[0]
    try:
        return _command(name)(list(argv[len(name.split()) :]))
    except V2PError as error:
        known = name in COMMANDS or name in SUBCOMMANDS
        print(f"v2p {name}: {error}" if known else f"v2p: {error}", file=sys.stderr)
        return NOT_ALL if isinstance(error, NotAllError) else NOTHING
    except OSError as error:
        if (refusal := write_refusal(error)) is None:
            raise
        print(f"v2p {name}: {error.filename or 'a file'}: {refusal}", file=sys.stderr)
        return NOTHING
    except KeyboardInterrupt:
        print(
            f"\nv2p {name}: stopped; what was finished is kept, the same command goes on from there",
            file=sys.stderr,
        )
        return 130


def parse[T](kind: type[T], argv: list[str], command: str, default: T | None = None) -> T:
    """Return the arguments as the dataclass `kind`; field docstrings are the help.

    Raises:
        V2PError: an argument is wrong; tyro's own words in one sentence.
    """
    import tyro

    wants_help = any(a in ("-h", "--help") for a in argv)
    words = io.StringIO()
    keywords: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(words):
            return tyro.cli(
                kind,
                args=argv,
                prog=f"v2p {command}",
                description=(COMMANDS | SUBCOMMANDS)[command][1],
                **keywords,
            )
    except SystemExit as error:
        if wants_help or not error.code:
            raise
        wrong = _by_option(_one_sentence(words.getvalue()), argv)
        raise V2PError(f"{wrong}.{_meant(argv, command)} See 'v2p {command} --help'") from error


def command_of(provenances: Sequence[Mapping[str, Any]]) -> list[str] | None:
    """Return the command line that the newest of these records was made by, with all its settings; None where it is not known."""
    newest = max(provenances, key=lambda made: str(made.get("time", "")), default={})
    argv = [str(word) for word in newest.get("argv", [])]
    return argv if argv[1:2] and argv[1] in COMMANDS else None


def _meant(argv: list[str], command: str) -> str:
    """Return the command of two words that may have been meant, where the first argument is no path."""
    if not argv or argv[0].startswith("-") or Path(argv[0]).exists():
        return ""
    close = difflib.get_close_matches(f"{command} {argv[0]}", SUBCOMMANDS, n=1, cutoff=0.8)
    return f" Did you mean 'v2p {close[0]}'?" if close else ""


def _one_sentence(box: str) -> str:
    text = re.sub(r"[╭╮╰╯│─]+|[+|]?-{3,}[+|]?|^\||\|$", " ", box, flags=re.M)
    text = re.sub(r"\s+", " ", text).strip()
    text = re.sub(r"^(Unrecognized options|Parsing error|Required options)\s+", "", text)
    text = re.sub(r"For full helptext, (run|see):? .*$", "", text)
    return text.strip().removesuffix(".")


def _by_option(wrong: str, argv: list[str]) -> str:
    """Return a setting's own words about its value with the option as it was typed, not by its inner name."""
    found = re.fullmatch(r"(?:Value error )?Error parsing ([\w.]+): (\w+)( must .*)", wrong)
    if found is None:
        return wrong
    inner, field, must = found.groups()
    for word in argv:
        option = word.split("=")[0]
        name = option.removeprefix("--").replace("-", "_")
        if option.startswith("--") and f".{inner}.{field}".endswith(f".{name}"):
            return option + must
    return f"{field}{must}"


def _command(name: str) -> Callable[[list[str]], int]:
    known = COMMANDS | SUBCOMMANDS
    if name not in known:
        raise V2PError(f"there is no command '{name}'.{did_you_mean(name, COMMANDS)}")
    from importlib import import_module

    module = import_module(f"v2p_data.commands.{known[name][0]}")
    return getattr(module, f"{name.split()[-1]}_command")


def _help() -> str:
    width = max(map(len, (*COMMANDS, *SUBCOMMANDS)))
    lines = [
        f"  {name:<{width}}  {words}"
        for command, what in COMMANDS.items()
        for name, (_, words) in [
            (command, what),
            *(pair for pair in SUBCOMMANDS.items() if pair[0].split()[0] == command),
        ]
    ]
    return "\n".join(
        [
            "usage: v2p COMMAND ...",
            "",
            "A folder of ordinary videos becomes simulated tasks, experts, a LeRobot dataset and a policy.",
            "",
            *lines,
            "",
            "Exit codes:",
            *(f"  {code:<{width}}  {words}" for code, words in EXIT_CODES.items()),
            "",
            "Start with:  v2p generate VIDEOS --out DIR --repo-id USER/NAME",
            "More on one: v2p COMMAND --help",
        ]
    )


if __name__ == "__main__":
    main()
