"""Programs as a model that writes rewards for a living writes them; none may be turned away without a good reason."""

from escapes import program

_QUATERNIONS = '''def quat_conjugate(q):
    return torch.cat([q[:, :1], -q[:, 1:]], dim=-1)

def quat_multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    aw, ax, ay, az = a[:, 0], a[:, 1], a[:, 2], a[:, 3]
    bw, bx, by, bz = b.unbind(dim=-1)
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return torch.stack([w, x, y, z], dim=-1)

def rotation_angle(a, b):
    """Angle between two orientations [rad]."""
    d = quat_multiply(a, quat_conjugate(b))
    return 2.0 * torch.asin(torch.clamp(torch.norm(d[:, 1:4], p=2, dim=-1), max=1.0))'''

ACCEPTED: dict[str, str] = {
    "where and clamp": program("m = torch.where(x > 0, x, torch.zeros_like(x)).clamp(0.0, 1.0)"),
    "a norm with a power": program("d = (x[:, 0] ** 2 + x[:, 1] ** 2 + 1e-8) ** 0.5"),
    "torch.linalg": program("n = torch.linalg.norm(x, dim=-1) if len(states) > 3 else x"),
    "quaternions by hand": program(
        "a = rotation_angle(states['box_quat'], states['eef_quat'])"
    ).replace("#TOP", _QUATERNIONS),
    "yaw from a quaternion": program(
        "w, i, j, k = states['box_quat'].unbind(-1)\n"
        "yaw = torch.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))\n"
        "c = torch.cos(yaw).abs() > math.cos(math.pi / 6)"
    ),
    "constants of the module": program("y = x[:, 2] > LIFT_HEIGHT + MARGINS['z']").replace(
        "#TOP",
        "LIFT_HEIGHT: float = 0.5 * 0.2\nMARGINS = {'xy': 0.02, 'z': 0.01}\nTILT = math.pi / 6\nFAR = -1e9",
    ),
    "constants of the class": program("y = x[:, 2] > self.HEIGHT").replace(
        "#MEMBER", "HEIGHT: float = 0.1\n    WEIGHTS = (0.3, 0.7)\n    NAMES: List[str] = ['box']"
    ),
    "settings in the constructor": program("y = x[:, 2] > self.height * self.scale").replace(
        "#INIT",
        'self.height = 0.1\n        self.scale: float = 2\n        self.task_description = "lift the box"',
    ),
    "a helper method": program("y = self.height_of(states)").replace(
        "#MEMBER",
        "def height_of(self, states):\n        return states['box_pos'][:, 2] - states['table_height']\n",
    ),
    "a static helper": program("y = self.shaped(x[:, 2], 8.0)").replace(
        "#MEMBER",
        "@staticmethod\n    def shaped(d, k=10.0):\n        return 1 - torch.tanh(k * d)\n",
    ),
    "two scripted helpers": program("b = near(x, states['eef_pos']) * 2.0", "FUNCTION")
    .replace("x, states", "states['box_pos'], states")
    .replace(
        "#TOP",
        "@torch.jit.script\ndef near(a, b):\n    # type: (Tensor, Tensor) -> Tensor\n    return "
        "torch.exp(-10.0 * torch.norm(a - b, dim=-1))",
    ),
    "a dict of components built up": program(
        "parts = {}\nfor name, w in [('reach', 0.3), ('lift', 0.7)]:\n    parts[name] = w * r\n"
        "total = sum(parts.values())\nreturn total, parts",
        "FUNCTION",
    ),
    "an early return": program("if len(states) > 2:\n    return r * 0.5, {'r': r}", "FUNCTION"),
    "a loop over names": program(
        "names = ['box']\nd = torch.zeros(x.shape[0], device=x.device)\n"
        "for name in names:\n    d += torch.norm(states[name + '_pos'] - states['eef_pos'], dim=-1)"
    ),
    "a key from an f-string": program("name = 'box'\ny = states[f'{name}_pos']"),
    "a look at which keys there are": program(
        "keys = [k for k in states.keys() if k.endswith('_pos') and not k.startswith('eef')]\n"
        "y = torch.stack([states[k] for k in sorted(keys)], dim=1).mean(dim=1)"
    ),
    "a state that may be missing": program("w = states.get('box_width', states['box_size'])"),
    "in place on a tensor of its own": program(
        "d = torch.zeros_like(x)\nd += x\nd[:, 2] = 0.0\nd[d < 0] = 0\nd.clamp_(0.0, 1.0)\nd.mul_(2.0)"
    ),
    "in place on a copy": program("d = x.clone()\nd[:, 2] -= 0.1"),
    "logical combinations": program(
        "a = (x[:, 2] > 0.1) & ~(x[:, 0] < 0) | (states['box_grasped'] > 0.5)\n"
        "b = torch.logical_and(a, states['box_up'] > 0.9).float()"
    ),
    "unsqueeze, expand and to": program(
        "g = torch.tensor([0.5, 0.0, 0.2], dtype=torch.float32).to(x.device)\n"
        "g = g.unsqueeze(0).expand(x.shape[0], -1)\nd = (x - g).norm(dim=-1)"
    ),
    "the older tensor constructor": program(
        "up = torch.FloatTensor([0.0, 0.0, 1.0]).to(x.device)\nd = (x * up).sum(-1)"
    ),
    "a matrix product": program("R = torch.eye(3, device=x.device)\ny = x @ R"),
    "a batched matrix product": program("y = torch.bmm(x.unsqueeze(1), x.unsqueeze(2)).squeeze()"),
    "the largest of each row": program(
        "m = x.max(dim=-1).values\ni = torch.max(x, dim=-1).indices\ns = torch.sort(x).values"
    ),
    "isinstance of a tensor": program(
        "if isinstance(x, torch.Tensor) and not isinstance(x, (int, float)):\n    x = x.float()"
    ),
    "a Gaussian of the distance": program(
        "s = 0.05\ng = torch.exp(-0.5 * (torch.norm(x - states['eef_pos'], dim=-1) / s) ** 2)"
    ),
    "stages of a reward": program(
        "grasped = states['box_grasped'] > 0.5\nlift = (states['box_pos'][:, 2] - "
        "states['box_start_pos'][:, 2]).clamp(min=0)\n"
        "stage = torch.where(grasped, 1.0 + lift * 5.0, r)\n"
        "penalty = 0.01 * torch.sum(actions ** 2, dim=-1)\n"
        "return stage - penalty, {'stage': stage, 'penalty': -penalty}",
        "FUNCTION",
    ),
    "masked fill and nan": program(
        "d = torch.nan_to_num(x[:, 0] / x[:, 1]).masked_fill(x[:, 2] < 0, 0.0)"
    ),
    "losses by name": program(
        "a = torch.nn.functional.smooth_l1_loss(x, states['eef_pos'], reduction='none').sum(-1)\n"
        "b = torch.nn.functional.normalize(x, dim=-1)\nc = torch.nn.functional.cosine_similarity(x, b, dim=-1)"
    ),
    "an observation of its own": program(
        "def compute_observation_key(self, states):\n    keys = super().compute_observation_key(states)\n"
        "    states['height'] = states['box_pos'][:, 2:3]\n    keys += ['height', 'gripper_width']\n    return keys\n"
        "def get_observation_space(self):\n    return super().get_observation_space() + 2",
        "MEMBER",
    ),
    "a reset of its own": program(
        "def reset_objects_states(self, env_ids):\n    poses = self.envs.sample_object_poses(env_ids)\n"
        "    poses['box'][:, 0] = poses['box'][:, 0].clamp(0.4, 0.6)\n    return poses",
        "MEMBER",
    ),
    "types from typing": program("w: float = 1.0").replace(
        "#TOP",
        "from typing import Dict, Tuple\nfrom torch import Tensor\nfrom factory.tasks.task import Task\n"
        "def f(states: Dict[str, Tensor], k: float = 2.0) -> Tuple[Tensor, Dict[str, Tensor]]:\n  "
        "  return states['eef_pos'], states",
    ),
    "a docstring with signs": program(
        'def f(d):\n    r"""Angle \\d in {degrees}, 50 % of it: 1\u00b0, \u2264 2 '
        '\u00b5m\u00a0-\u2013 "good"."""\n    return d',
        "TOP",
    ),
    "a percent sign in a text": program("y = 'box_%s' % 'pos'\nz = states[y]"),
    "conditions on python numbers": program(
        "k = 1.0\nif x.shape[0] > 8:\n    k = 2.0\nelif len(x) == 1:\n    k = 3.0\nelse:\n    pass"
    ),
    "any and all": program("b = any([k == 'eef_pos' for k in states]) and all([len(x) > 0])"),
    "a rounding division": program("y = torch.div(x, 2, rounding_mode='floor')"),
    "comments only": program("# type: ignore\n# noqa\ny = 1  # TODO: tune 0.1"),
}
"""What the reader accepts and what runs in the child."""

REFUSED_WITH_ADVICE: dict[str, tuple[str, str]] = {
    "print": (program("print(x)"), "leave it out"),
    "hasattr": (program("y = hasattr(self, 'z')"), "__init__"),
    "getattr": (program("y = getattr(self, 'z', 0)"), "__init__"),
    "type": (program("y = type(x)"), "isinstance"),
    "set": (program("y = set(['a'])"), "list"),
    "map": (program("y = map(abs, [1])"), "comprehension"),
    "pow": (program("y = pow(2, 3)"), "torch.pow"),
    "lambda": (program("f = lambda d: 1 - d"), "function at module level"),
    "while": (program("while False:\n    pass"), "for with range"),
    "try": (program("try:\n    y = 1\nexcept KeyError:\n    y = 2"), "should be seen"),
    "no_grad": (program("with torch.no_grad():\n    y = x"), "with is not allowed"),
    "noise": (program("y = torch.rand_like(x)"), "torch.rand_like"),
    "numpy": (program("y = x.cpu().numpy()"), "numpy"),
    "import numpy": (program("import numpy as np", "TOP"), "torch and math"),
    "a nested function": (program("def f(d):\n    return d\ny = f(x)"), "inside functions"),
    "a generator": (program("y = sum(v for v in [1, 2])"), "list"),
    "a tensor for a constant": (program("GOAL = torch.tensor([0.5, 0, 0.2])", "TOP"), "constant"),
    "a huge count": (program("y = torch.zeros(100000000)"), "1e+06"),
    "a division that ends the process": (
        program("y = torch.div(x.int(), -1, rounding_mode='trunc')"),
        "torch.trunc(a / b)",
    ),
    "its rounding by another name": (
        program("m = 'trunc'\nd = torch.div\ny = d(x.int(), -1, rounding_mode=m)"),
        "torch.trunc(a / b)",
    ),
    "an attribute read in an f-string": (program("y = f'{x.device}'"), "plain names"),
}
"""What is refused although it means no harm, with words that must be in the sentence."""
