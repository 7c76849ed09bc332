"""The `v2p` command: parse, call, print what was made, the number that matters and the next command.

Only light modules are imported here, so that `v2p --help` answers at once; each command imports what it needs.
"""

import difflib
import io
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from v2p_data.errors import NOT_ALL, NOTHING, NotAllError, V2PError, did_you_mean, write_refusal

COMMANDS: dict[str, tuple[str, str]] = {
    "try": ("run", "one clip becomes a scene, a task, an expert and episodes, in about a minute"),
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
    "scene camera": ("camera", "what all scenes of a run say of the one camera that filmed them"),
    "scene review": ("review", "a page to judge a run's scenes on and to mark what was not found"),
    "task": ("run", "up to the task code and its audit"),
    "reward": ("reward", "up to the rewards: rounds of them, trained against each other"),
    "reward search": ("reward", "search for one task's reward"),
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
    "status": ("status", "what a run folder holds, and what failed and why"),
    "report": ("status", "write a run's page again"),
    "show": ("show", "a task's code and audit; what a reward search tried, and why"),
    "gc": ("gc", "what can be deleted of a run folder, and what making it again would cost"),
    "setup": ("setup", "which learned models are set up here; with a name, set one up"),
    "demo": ("run", "the whole chain on three sample clips"),
}
"""Command -> module of `v2p_data.commands` that holds it, and what it does; a folder of a second word's name is given
as `./review`."""
FIRST_WORD_S = 1.0
"""After so long a command that still loads says so."""
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
    if isinstance(
        sys.stdout, io.TextIOWrapper
    ):  # a terminal that is not of UTF-8 shows other letters by number
        sys.stdout.reconfigure(errors="backslashreplace")
    # Nobody waits for long without a word: libraries take seconds to load, on a busy machine many.
    word = threading.Timer(
        FIRST_WORD_S, print, ["v2p: loading libraries"], {"file": sys.stderr, "flush": True}
    )
    word.daemon = True
    word.start()
    # The Ctrl-C of a pipe's reader (`v2p status | head`) is no error of ours.
    try:
        sys.exit(run(sys.argv[1:], on_loaded=word.cancel))
    except BrokenPipeError:
        os._exit(0)


def run(argv: Sequence[str], on_loaded: Callable[[], object] = lambda: None) -> int:
    """Return the exit code of `v2p` with these arguments; tell when the command's modules are loaded."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_help())
        return 0
    if argv[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(f"v2p {version('lerobot_policy_v2p')}")
        return 0
    name = " ".join(argv[:2]) if " ".join(argv[:2]) in COMMANDS else argv[0]
    try:
        command = _command(name)
        on_loaded()
        return command(list(argv[len(name.split()) :]))
    except V2PError as error:
        print(f"v2p {name}: {error}" if name in COMMANDS else f"v2p: {error}", file=sys.stderr)
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
        V2PError: an argument is wrong.
    """
    import tyro
    from tyro._errors import ParseErrorEvent, on_parse_error

    def refuse(event: ParseErrorEvent) -> None:
        if wrong := _sentence(event, kind, argv):
            raise V2PError(f"{wrong}{_meant(argv, command)} See 'v2p {command} --help'")

    keywords: dict[str, Any] = {} if default is None else {"default": default}
    with on_parse_error(refuse):
        return tyro.cli(
            kind,
            args=argv,
            prog=f"v2p {command}",
            description=COMMANDS[command][1],
            **keywords,
        )


def command_of(provenances: Sequence[Mapping[str, Any]]) -> list[str] | None:
    """Return the command line that made the newest of these records, with all its settings; None if it is not known."""
    newest = max(provenances, key=lambda made: str(made.get("time", "")), default={})
    argv = [str(word) for word in newest.get("argv", [])]
    return argv if argv[1:2] and argv[1] in COMMANDS else None


def _meant(argv: list[str], command: str) -> str:
    """Return the command of two words that may have been meant, where the first argument is no path."""
    if not argv or argv[0].startswith("-") or Path(argv[0]).exists():
        return ""
    close = difflib.get_close_matches(f"{command} {argv[0]}", COMMANDS, n=1, cutoff=0.8)
    return f" Did you mean 'v2p {close[0]}'?" if close and " " in close[0] else ""


def _sentence(event: Any, kind: type, argv: list[str]) -> str:
    """Return in a sentence what tyro found wrong; empty for what tyro says itself."""
    from tyro import _errors as wrong

    match event:
        case wrong.MissingArgs():
            unknown = "".join(f", and {word} is unknown" for word in event.unrecognized_tokens[:1])
            names = ", ".join(missing.arg.display_name() for missing in event.missing_arguments)
            return f"missing: {names}{unknown}."
        case wrong.UnrecognizedArgs():
            word = event.tokens[0].partition("=")[0]
            close = difflib.get_close_matches(word, options_of(kind), n=1)
            return f"{word} is unknown.{f' Did you mean {close[0]}?' if close else ''}"
        case wrong.InvalidChoice():
            return f"{event.argument.display_name()} is {' or '.join(sorted(event.choices))}, not '{event.value}'."
        case wrong.BadValue():
            return f"{event.argument.display_name()} lacks a value."
        case wrong.InstantiationFailure() if event.argument is not None:
            return f"{event.argument.display_name()}: {event.message}."
        case wrong.InstantiationFailure():
            # A class's own words begin with the name of the field that it refuses.
            field, _, rest = event.message.partition(" ")
            options = [word.partition("=")[0] for word in argv if word.startswith("--")]
            typed = [o for o in options if _field(o) == field]
            return f"{typed[0]} {rest}." if typed else f"{event.message}."
    return ""


def _field(option: str) -> str:
    """Return the name of the field that an option sets."""
    return option.removeprefix("--").rpartition(".")[2].replace("-", "_")


def options_of(kind: type, prefix: str = "--") -> Iterator[str]:
    """Yield the options of a command's dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        notes = getattr(hints[field.name], "__metadata__", ())
        inner = get_args(hints[field.name])[0] if notes else hints[field.name]
        is_nameless = any(getattr(note, "name", None) == "" for note in notes)
        name = prefix if is_nameless else f"{prefix}{field.name.replace('_', '-')}"
        if isinstance(inner, type) and is_dataclass(inner):
            yield from options_of(inner, name if is_nameless else f"{name}.")
        else:
            yield name
        if inner is bool:
            yield f"{prefix}no-{field.name.replace('_', '-')}"


def _command(name: str) -> Callable[[list[str]], int]:
    if name not in COMMANDS:
        raise V2PError(f"there is no command '{name}'.{did_you_mean(name, COMMANDS)}")
    from importlib import import_module

    module = import_module(f"v2p_data.commands.{COMMANDS[name][0]}")
    return getattr(module, f"{name.split()[-1]}_command")


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {words}" for name, (_, words) in COMMANDS.items()]
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
