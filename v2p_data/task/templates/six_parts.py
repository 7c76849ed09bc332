"""The text of a task in the paper's six parts: scene information, reset, observation, its size, success, reward."""

import pprint
import re

from v2p_data.kinds import Kind
from v2p_data.scene.scene import Scene
from v2p_data.task.sandbox.probes import first_pose
from v2p_data.task.templates.draft import Draft, Measured
from v2p_data.task.templates.helper_functions import plain, with_helpers
from v2p_data.task.templates.reward_text import docstring_lines, reward_lines
from v2p_data.task.templates.variants import Variant


def task_text(scene: Scene, m: Measured, v: Variant, d: Draft) -> str:
    """Return the task code that a draft stands for."""
    caption = " ".join(scene.description.split())
    name = _class_name(caption, scene.kind)
    known = [*_state_lines(m), *d.setup]
    parts = [
        "import torch\nfrom factory.tasks.task import Task\n",
        f"scene_info = {_scene_info(scene, name)}\n",
        f"class {name}(Task):",
        *_indented(_class_body(caption, known, v, d)),
        "\n\n# REWARD FUNCTION\n@torch.jit.script\ndef reward_function(actions, states):",
        *_indented(
            [
                "# type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]",
                *docstring_lines(v, d),
                *_used(known + d.reward_setup, reward_lines(v, d)),
            ]
        ),
    ]
    return with_helpers("\n".join(parts), m) + "\n"


def _class_body(caption: str, known: list[str], v: Variant, d: Draft) -> list[str]:
    observations = _observations(v, d)
    observe = [line for key, text, _ in observations for line in _observe(key, text)]
    return [
        f'"""{plain(caption)}"""',
        "",
        "def __init__(self, envs, urdf_assets_root):",
        "    super().__init__(envs, urdf_assets_root, scene_info)",
        f"    self.task_description = {caption!r}",
        "",
        "def reset_objects_states(self, env_ids):",
        "    return super().reset_objects_states(env_ids)",
        "",
        "def compute_observation_key(self, states):",
        "    obs_keys = super().compute_observation_key(states)",
        *_indented(_used(known, observe)),
        "    return obs_keys",
        "",
        "def get_observation_space(self):",
        "    obs_space = super().get_observation_space()",
        f"    return obs_space + {sum(dim for _, _, dim in observations)}",
        "",
        "def compute_success(self, states):",
        *_indented(_used(known, _success_lines(v, d))),
        "",
        "def compute_reward(self, actions, states):",
        "    return reward_function(actions, states)",
    ]


def _class_name(caption: str, kind: Kind) -> str:
    words = re.findall(r"[A-Za-z][A-Za-z0-9]*", caption)[:10] or kind.split("_")
    return "".join(w[0].upper() + w[1:] for w in words)[:60] + "Task"


def _scene_info(scene: Scene, class_name: str) -> str:
    objects = [
        {
            "name": o.name,
            "label": o.label,
            "role": o.role,
            "size_m": [round(s, 4) for s in o.size_m],
            "urdf": o.urdf,
            "first_position": [round(float(c), 4) for c in first_pose(o)[:3]],
            "last_position": [round(float(c), 4) for c in o.last_pose[:3]]
            if o.poses_world
            else [],
        }
        for o in scene.objects
    ]
    info = {
        "task_class_name": class_name,
        "video": scene.video,
        "task_description": scene.description,
        "objects": objects,
    }
    return pprint.pformat(info, sort_dicts=False, width=100)


def _state_lines(m: Measured) -> list[str]:
    """Lines that give the states short names."""
    lines = [
        'eef_pos = states["eef_pos"]',
        'eef_quat = states["eef_quat"]',
        'gripper_width = states["gripper_width"]',
        'table_height = states["table_height"]',
    ]
    for short, obj in (("obj", m.obj), ("ref", m.ref)):
        if obj is None:
            continue
        n = obj.name
        lines += [
            f'{short}_pos = states["{n}_pos"]',
            f'{short}_quat = states["{n}_quat"]',
            f'{short}_size = states["{n}_size"]',
            f'{short}_start = states["{n}_start_pos"]',
            f'{short}_grasped = states["{n}_grasped"]',
            f'{short}_touched = states["{n}_touched"]',
        ]
    n = m.obj.name
    return [
        *lines,
        f'obj_start_quat = states["{n}_start_quat"]',
        f'obj_vel = states["{n}_vel_linear"]',
        f'obj_spin = states["{n}_vel_angular"]',
        "half_height = obj_start[:, 2] - table_height",
        "reach_limit = 0.05 + "
        + ("torch.norm(obj_size, dim=-1) / 2" if m.by_wall else "half_height"),
    ]


def _success_lines(v: Variant, d: Draft) -> list[str]:
    conditions = d.success[:1] if v.is_naive else d.success
    lines = [f"{name} = {expression}" for name, expression in conditions]
    return [*lines, "return " + " & ".join(name for name, _ in conditions)]


def _observations(v: Variant, d: Draft) -> list[tuple[str, str, int]]:
    known = {
        "distance": ("distance_to_object", "torch.norm(obj_pos - eef_pos, dim=-1) * 5", 1),
        "remaining": ("distance_to_go", f"({d.remaining}) * 5", 1),
        "goal": ("goal_offset", f"({d.goal} - obj_pos) * 5", 3),
    }
    return [known[name] for name in v.observes]


def _observe(key: str, expression: str) -> list[str]:
    return [f'states["{key}"] = {expression}', f'obs_keys.append("{key}")']


def _used(definitions: list[str], body: list[str]) -> list[str]:
    """Return the body with those definitions before it that it needs, in their order."""
    kept, text = list(body), "\n".join(body)
    for line in reversed(definitions):
        name = re.match(r"\w+", line)
        if name and re.search(rf"\b{name[0]}\b", text):
            kept.insert(0, line)
            text += "\n" + line
    return kept


def _indented(lines: list[str]) -> list[str]:
    return [f"    {line}" if line else "" for line in lines]
