"""The arrows of the house: a room imports only rooms below it."""

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LEAVES = {"errors", "json_files", "letters", "local_page", "processes"}
"""Every room may use them; they know nothing but each other."""
BELOW: dict[str, set[str]] = {
    "errors": set(),
    "json_files": set(),
    "letters": set(),
    "local_page": set(),
    "processes": set(),
    "seeds": set(),
    "kinds": set(),
    "pipeline": set(),
    "geometry": set(),
    "video": {"geometry", "seeds", "kinds"},
    "scene": {"video", "geometry", "seeds", "kinds"},
    "task": {"scene", "video", "geometry", "seeds", "kinds"},
    # The simulator runs task code, so it knows the task's interface and its sandbox; never the other way round.
    "sim": {"task", "scene", "geometry", "seeds", "kinds"},
    # It trains policies, as the reward search does.
    "experts": {"play", "sim", "task", "scene", "geometry", "pipeline", "seeds", "kinds"},
    "play": {"sim"},
    "episodes": {"play", "sim", "task", "scene", "geometry", "pipeline", "seeds", "kinds"},
    "distillation": {"episodes", "play", "sim", "task", "pipeline", "seeds", "kinds"},
    # A policy is whatever has `reset` and `act`; `judging` alone knows how one is loaded.
    "evaluation": {
        "experts",
        "play",
        "sim",
        "task",
        "scene",
        "episodes",
        "pipeline",
        "seeds",
        "kinds",
    },
    # The second simulator shares scenes, states and judges with the first one, which knows nothing of it.
    "twin": {
        "experts",
        "evaluation",
        "play",
        "episodes",
        "sim",
        "task",
        "scene",
        "geometry",
        "seeds",
        "kinds",
    },
    "reward": {"experts", "play", "task", "sim", "scene", "pipeline", "seeds", "kinds"},
    # It sees the arm that policies were trained with, and what a robot is; never the twin's inside.
    "deployment": {
        "twin",
        "play",
        "evaluation",
        "episodes",
        "sim",
        "task",
        "scene",
        "geometry",
        "pipeline",
        "seeds",
    },
    "policy": {
        *("deployment", "distillation", "evaluation", "episodes", "experts", "play"),
        *("scene", "task", "pipeline", "seeds"),
    },
    "report": {"episodes", "sim", "task", "scene", "video", "geometry", "pipeline"},
}
INSIDE: dict[str, dict[str, set[str]]] = {
    "scene": {
        # The artefact, which other rooms of the house read.
        "files": set(),
        "schema": {"files"},
        "scene": {"schema", "files"},
        # Learned models know pictures and numbers, nothing of ours.
        "backends": {"files"},
        "config": {"backends"},
        "scale": {"schema"},
        # A working clip holds the model that is asked about its frames.
        "frames": {"scale", "backends"},
        "data_types": {"frames", "scale", "schema"},
        "grounding": {"data_types", "frames", "scale", "backends", "schema"},
        "shapes": {"data_types", "frames", "scale", "backends"},
        "fitting": {
            *("shapes", "grounding", "data_types", "frames", "scale"),
            *("backends", "config", "schema"),
        },
    },
    "sim": {
        "robot": set(),
        "model": {"robot"},
        "env": {"model", "robot"},
        "render": {"env", "model", "robot"},
    },
    "task": {
        "robot_files": set(),
        "cache": set(),
        "schema": {"robot_files"},
        "task": {"schema", "robot_files"},
        "likeness": {"task"},
        "sandbox": {"task", "cache"},
        "templates": {"sandbox"},
        "audit": {"templates", "sandbox", "task"},
        "llm": {"audit", "templates", "sandbox", "likeness", "task"},
    },
    "reward": {"trajectories": set(), "feedback": {"trajectories"}},
    "episodes": {
        "staging": set(),
        "dataset": {"staging"},
        "rollouts": {"dataset"},
        "hub": {"dataset"},
    },
}
"""The order inside a room. What is not named here stands above all that is."""
TOP = {"stages", "craft_data", "cli", "commands"}
EXEMPT = {
    # Compiled kernels: a dataclass is nothing that they can take.
    "raster._fill",
    "raster.paint",
    "warp_physics._control",
    # Gymnasium makes it from keywords, which users write.
    "gym_env.V2PEnv.__init__",
    # Its keywords are the entries of a task's YAML file; a wrong one is refused by name.
    "benchmark._object",
}
"""What may be larger than other functions are."""


@functools.cache
def imported_modules(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module)
    return names


def room_of(path: Path) -> str:
    return path.relative_to(ROOT / "v2p_data").parts[0].removesuffix(".py")


MODULES = sorted((ROOT / "v2p_data").rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_room_imports_only_rooms_below_it(path):
    room = room_of(path)
    if room in TOP or (path.name == "__init__.py" and path.parent.name == "v2p_data"):
        return
    ours = {n.split(".")[1] for n in imported_modules(path) if n.startswith("v2p_data.")}

    assert ours - BELOW[room] - LEAVES - {room} == set()


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_inside_a_room_too_arrows_point_down(path):
    room, *inner = path.relative_to(ROOT / "v2p_data").parts
    below = INSIDE.get(room, {})
    part = inner[0].removesuffix(".py") if inner else ""
    if part not in below:
        return
    ours = {n.split(".")[2] for n in imported_modules(path) if n.startswith(f"v2p_data.{room}.")}

    assert ours - below[part] - {part} == set()


def test_no_module_imports_itself_over_others():
    def name(path: Path) -> str:
        return ".".join(path.relative_to(ROOT).with_suffix("").parts)

    left = {name(p): imported_modules(p) for p in MODULES}
    while leaves := {module for module, used in left.items() if not used & left.keys()}:
        left = {module: used for module, used in left.items() if module not in leaves}

    assert sorted(left) == []


@pytest.mark.parametrize(
    "path", sorted((ROOT / "policies").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT))
)
def test_policies_know_nothing_of_the_engine(path):
    assert not [n for n in imported_modules(path) if n.split(".")[0] == "v2p_data"]


def test_the_engine_imports_no_drawn_clips_and_no_scripts():
    scripts = {p.stem for p in (ROOT / "scripts").iterdir() if p.suffix == ".py" or p.is_dir()}

    packages = ("v2p_data", "policies", "lerobot_policy_v2p")
    used = {
        name.split(".")[0]
        for package in packages
        for path in (ROOT / package).rglob("*.py")
        for name in imported_modules(path)
    }
    assert not used & (scripts | {"scripts", "tests"})


def test_the_engine_knows_policies_only_at_the_top():
    users = {
        room_of(p)
        for p in MODULES
        if any(n.split(".")[0] == "policies" for n in imported_modules(p))
    }

    # `report` reads the one type of a success rate.
    assert users <= TOP | {"experts", "reward", "report", "evaluation", "policy"}


def test_one_heavy_library_has_one_file():
    homes = {
        "av": {"v2p_data/video", "v2p_data/scene", "v2p_data/report"},
        "openai": {"v2p_data/task/llm"},
    }
    for library, allowed in homes.items():
        users = {
            str(p.parent.relative_to(ROOT))
            for p in MODULES
            if any(n.split(".")[0] == library for n in imported_modules(p))
        }
        assert users <= allowed, library


def test_no_package_of_ours_hides_hugging_faces_datasets():
    assert not (ROOT / "datasets" / "__init__.py").exists()


def test_the_code_map_names_every_room():
    text = (ROOT / "docs/code_map.md").read_text()
    rooms = {p.parent.name for p in (ROOT / "v2p_data").rglob("__init__.py")} - {"v2p_data"}
    elsewhere = (ROOT / "docs/scene_rooms.md").read_text()

    assert {room for room in rooms if f"{room}/" not in text + elsewhere} == set()


def names_and_nodes(tree: ast.AST, outer: str = "") -> list[tuple[str, ast.AST]]:
    """Return the classes and functions of a module, each with its name after that of its class."""
    found: list[tuple[str, ast.AST]] = []
    for node in ast.iter_child_nodes(tree):
        name = outer
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            name = f"{outer}.{node.name}".lstrip(".")
            found.append((name, node))
        found += names_and_nodes(node, name)
    return found


def test_functions_have_at_most_7_parameters_and_60_lines_and_classes_300_lines():
    """`self` and `cls` are no parameters; docstrings count as lines."""
    large: set[str] = set()
    for package in ("v2p_data", "policies", "lerobot_policy_v2p"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for name, node in names_and_nodes(ast.parse(path.read_text())):
                lines = getattr(node, "end_lineno", 0) - getattr(node, "lineno", 0) + 1
                arguments = getattr(node, "args", None)
                count = 0
                if arguments is not None:
                    args = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
                    named = [a.arg for a in args if a.arg not in ("self", "cls")]
                    count = len(named) + bool(arguments.vararg) + bool(arguments.kwarg)
                if count > 7 or lines > (300 if isinstance(node, ast.ClassDef) else 60):
                    large.add(f"{path.stem}.{name}")

    assert large == EXEMPT
