"""Settings of the commands that make things: how they are read, and the flags that say them again."""

import argparse
import math
import os
import shlex
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from v2p_data.cli import parse
from v2p_data.errors import V2PError
from v2p_data.pipeline.ray_engine import demand_ray
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.settings import load_settings
from v2p_data.stages import EngineConfig


@dataclass(frozen=True, kw_only=True)
class How:
    """How to run; never part of what is made."""

    workers: int = 0
    """Jobs at the same time; 0: as many as there are cores, here or on the cluster."""
    threads: int = 1
    """Threads per job."""
    device: str = "cpu"
    """Where the policy trains: cpu, cuda, mps."""
    store: str = ""
    """Folder that drivers and machines share results in; each keeps an --out of its own."""
    lease_s: float = 60.0
    """With --store: a driver without a sign of life for so long is taken for dead by the others."""
    limit_s: float = 0.0
    """A job that takes longer is ended, and its item has failed; 0: no limit. A policy may take days."""
    engine: Literal["local", "ray"] = "local"
    """Where jobs run: processes of this machine, or tasks of a Ray cluster whose nodes share --out."""
    address: str = "auto"
    """Of the Ray cluster's head, HOST:PORT; auto: the one that this machine belongs to."""

    def runtime(self, root: Path) -> Runtime:
        if self.workers < 0 or self.threads < 1:
            raise V2PError(
                f"--workers is at least 0 and --threads at least 1, got {self.workers} and {self.threads}"
            )
        if not 0 < self.lease_s < math.inf:
            raise V2PError(f"--lease-s is a number of seconds above 0, got {self.lease_s}")
        if not 0 <= self.limit_s < math.inf:
            raise V2PError(f"--limit-s is a number of seconds, 0 for no limit, got {self.limit_s}")
        if self.engine == "ray":
            demand_ray()
        else:
            check_device(self.device)
        return Runtime(
            root=root,
            workers=self.workers or (0 if self.engine == "ray" else os.cpu_count() or 1),
            num_threads=self.threads,
            device=self.device,
            engine=self.engine,
            address=self.address,
            store=self.store,
            lease_s=self.lease_s,
            limit_s=self.limit_s,
        )


Engine = Annotated[EngineConfig, tyro.conf.arg(name="")]
Running = Annotated[How, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What all commands that make things are told."""

    config: Path | None = None
    """YAML file with settings; flags go over it."""
    engine: Engine = field(default_factory=EngineConfig)
    how: Running = field(default_factory=How)


def with_config[T: Settings](kind: type[T], argv: list[str], name: str) -> T:
    """Parse with the values of the file that --config names, if one is named, as the defaults of the flags."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config", type=Path, nargs="?")
    path = parser.parse_known_args(argv)[0].config
    if path is None:
        return parse(kind, argv, name)
    missing = {
        field.name: tyro.MISSING
        for field in fields(kind)
        if field.default is field.default_factory  # both MISSING: required
    }
    return parse(kind, argv, name, default=kind(engine=_usual(path), **missing))


def _usual(config: Path | None) -> EngineConfig:
    """Return the settings where no flag is given."""
    return load_settings(config, EngineConfig) if config else EngineConfig()


def changed_flags(settings: Any, usual: Any, prefix: str = "--") -> list[str]:
    """Return the flags that make these settings of the usual ones: without them the next command would do all anew."""
    flags: list[str] = []
    for each in fields(settings):
        value, was = getattr(settings, each.name), getattr(usual, each.name)
        name = prefix + each.name.replace("_", "-")
        if is_dataclass(value):
            flags += changed_flags(value, was, f"{name}.")
        elif isinstance(value, bool) and value != was:
            flags.append(name if value else f"{name[: len(prefix)]}no-{name[len(prefix) :]}")
        elif isinstance(value, tuple) and value != was:
            flags += [name, *map(str, value)]
        elif value != was:
            flags.append(f"{name}={value}")
    return flags


def goes_on(command: str, source: Path, args: Settings, *more: str) -> str:
    """Return a command line on `source` with the settings of this one."""
    file = ["--config", str(args.config)] if args.config else []
    flags = changed_flags(args.engine, _usual(args.config)) + changed_flags(args.how, How())
    return shlex.join(["v2p", *command.split(), str(source), *more, *file, *flags])


def run_folder_for(out: Path) -> Path:
    if (out / "meta" / "info.json").is_file():
        raise V2PError(
            f"{out} is a LeRobot dataset, and v2p never writes into one; choose another --out"
        )
    if out.exists() and not out.is_dir():
        raise V2PError(f"{out} is a file; --out must be a folder")
    return out


def check_device(name: str) -> None:
    """Refuse a device that this machine lacks.

    Raises:
        V2PError: names those there are.
    """
    if name == "cpu":
        return
    import torch

    found = ["cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))]
    found += ["cuda"] if torch.cuda.is_available() else []
    found += ["mps"] if torch.backends.mps.is_available() else []
    if name not in found:
        raise V2PError(f"--device {name} is not on this machine; it has {', '.join(found)}")
