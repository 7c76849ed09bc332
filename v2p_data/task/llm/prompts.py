"""What is said to the model that writes task code: the interface, the guard's rules, the scene, and what to do.

Everything that the code enforces is said from the same tables that it is enforced with: the states from `task`, the
allow-lists and limits from `allowed`.
"""

import re
from collections.abc import Sequence

import numpy as np

from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.audit.audit import ACCEPTABLE_SCORE, Audit
from v2p_data.task.llm.example_refinements import Refinement
from v2p_data.task.llm.example_tasks import Example
from v2p_data.task.llm.pictures import Picture
from v2p_data.task.sandbox import allowed
from v2p_data.task.sandbox.probes import WORKSPACE_M
from v2p_data.task.task import FULL_REWARD, states_table

Message = dict[str, object]

INTERFACE = """\
You write tasks for a robot arm with a parallel gripper in a physics simulator. A task is one Python file with six parts:

1. Scene information: a module-level `scene_info = {{"task_class_name": "...", "objects": ["...", ...]}}` with the names below.
2. `reset_objects_states(self, env_ids)`: object name -> tensor (len(env_ids), 7), `[x, y, z, qw, qx, qy, qz]`. Return
   `super().reset_objects_states(env_ids)`: it places the objects as in the video's first frame, at random, resting on
   the table. Only change its result where the task needs a relation that it cannot know. Never start solved.
3. `compute_success(self, states)`: bool tensor (env,). The most important part: see the questions below.
4. `compute_observation_key(self, states)`: the list from `super().compute_observation_key(states)`, to which names of
   further observations may be appended that you put into `states` here: tensors (env,) or (env, k), about -1 to 1.
   What you put there can be read in success and reward. Never overwrite a state that is there.
5. `get_observation_space(self)`: `super().get_observation_space()` plus the number of columns that you appended.
6. `compute_reward(self, actions, states)`, which returns `reward_function(actions, states)`; and the module-level
   `reward_function(actions, states)`, decorated with `@torch.jit.script`, which returns the total reward (env,) float32
   and a dict of its named components, each (env,). `actions` is (env, 7), -1 to 1. The docstring holds your chain of
   thoughts for the reward and the list of its components. Weigh the components so that they add up to about 1 just before
   success and return {full:g} times their sum. To each step in success the trainer adds a bonus by itself, so do not pay
   for success. Let the total rise smoothly from anywhere, reward the next step more than staying in the last, and let no moment
   before success be worth staying in for ever.

The class derives from `Task` (`from factory.tasks.task import Task`) and its constructor is
`def __init__(self, envs, urdf_assets_root): super().__init__(envs, urdf_assets_root, scene_info)`, followed by
`self.task_description = "..."`.
"""

WORLD = """\
Frame: metres, seconds, radians; z up, the table's top at z = table_height; x away from the robot, y to its left, as in the
picture. Quaternions are wxyz. The gripper reaches x {x0} to {x1} and y {y0} to {y1}. Objects start at random places and
headings, so never compare a position with a constant: compare with `<name>_start_pos`, with another object, or with a
size. Everything is batched: the first dimension is the environment; no `if` on tensors, no `.item()`, no reduction over
environments (`torch.max(x)` without `dim` is such a fault).

These are all states there are. Do not assume others, and no scalar values that they do not give:

{states}
"""

QUESTIONS = """\
Before you write, answer in a few sentences:
- What does the caption say was done, and what do the pictures and the tracked poses show of it? What must be different at
  the end from the start, and by how much did it differ in the video?
- Which condition on the states says exactly that? Is every threshold taken from the size of an object or from the way it
  went in the video, so that it is true at the video's end? Can the arm reach a state that satisfies it?
- Is it false at the start, wherever the objects were put? Is it false when the object is merely touched, flung past, lifted
  for one moment, or pushed off the table? Does it ask for stillness where the video ends still?
- Which steps lead there, and which component of the reward pulls the policy through each of them?"""

RULES = """\
The code is read by a guard that refuses whatever is not on its list, with the line and the reason:
- imports: `import torch`, `import math`, `from torch import Tensor`, names of typing, and `from factory.tasks.task import Task`.
- exactly one class, derived from Task; functions and constants (numbers, strings, lists, tuples, dicts of them) at module
  level; nothing else at module level.
- no while, try, with, lambda, generator expression, assert, raise, del, global, `:=`, starred arguments,
  `**` with anything but a number of at most {exponent} behind it, nested functions or classes; loops at most {loops} deep.
- no name or attribute with an underscore in front or at its end but `__init__` and those listed below.
- no strings or lists multiplied; f-strings with plain names only; numbers of at most {number:g}; at most {chars} characters.
- builtins: {builtins}.
- math: {math}.
- torch: {torch}.
- torch.linalg: {linalg}. torch.nn.functional: {functional}.
- attributes and methods of tensors, dicts and lists: the torch functions above, and {attributes}."""

FORMAT = """\
Answer with your thoughts, then with the whole file in one block fenced by ```python and ```. Nothing after it."""

TASK_QUESTION = f"{QUESTIONS}\n\n{FORMAT}"

REWARD_FORMAT = """\
Answer with your thoughts, then with one block fenced by ```python and ``` that holds `reward_function` with its docstring,
and the helper functions or constants that it needs, at module level. Everything else of the task stays as it is: you cannot
change success, reset or observations, and code for them is ignored. Nothing after the block."""

LINE_OF_FAULT = re.compile(r"\bline (\d+)")


def system_message(
    object_names: Sequence[str],
    examples: Sequence[Example] = (),
    refinements: Sequence[Refinement] = (),
) -> Message:
    """Return the part that is the same for all samples of a scene: interface, states, rules, examples."""
    parts = [f"{INTERFACE.format(full=FULL_REWARD)}\n{world_words(object_names)}", rules()]
    for number, example in enumerate(examples, 1):
        parts.append(
            f"Example {number}: {example.task}\n\nThoughts: "
            f"{example.thoughts}\n\n```python\n{example.code.strip()}\n```"
        )
    for number, refined in enumerate(refinements, 1):
        parts.append(
            REFINEMENT.format(
                number=number,
                task=refined.task,
                before=refined.before.strip(),
                seen=refined.seen.strip(),
                thoughts=refined.thoughts,
                after=refined.after.strip(),
                came_to=refined.came_to,
            )
        )
    return {"role": "system", "content": "\n\n".join(parts)}


def world_words(object_names: Sequence[str]) -> str:
    """Return the frame, the workspace and the table of all states in words."""
    (x0, y0), (x1, y1) = WORKSPACE_M
    return WORLD.format(x0=x0, x1=x1, y0=y0, y1=y1, states=states_table(list(object_names)))


def rules() -> str:
    """Return the guard's allow-lists and limits in words."""
    names = sorted(allowed.ATTRIBUTES - allowed.TORCH)
    return RULES.format(
        exponent=allowed.MAX_EXPONENT,
        loops=allowed.MAX_LOOP_DEPTH,
        number=allowed.MAX_NUMBER,
        chars=allowed.MAX_SOURCE_CHARS,
        builtins=_listed(allowed.BUILTINS),
        math=_listed(allowed.MATH),
        torch=_listed(allowed.TORCH),
        linalg=_listed(allowed.TORCH_NAMESPACES["linalg"]),
        functional=_listed(allowed.TORCH_NAMESPACES["nn.functional"]),
        attributes=", ".join(names),
    )


def scene_message(
    scene: Scene,
    pictures: Sequence[Picture],
    *,
    tracking: bool,
    shapes: bool,
    then: str,
    end: str,
) -> Message:
    """Return the question: the scene in words, what to do, pictures, then `end`, which differs by sample."""
    text = f"{scene_words(scene, tracking=tracking, shapes=shapes)}\n\n{then}"
    parts: list[dict[str, object]] = [{"type": "text", "text": text}]
    for picture in pictures:
        parts.append({"type": "text", "text": f"This picture shows {picture.shows}:"})
        parts.append({"type": "image_url", "image_url": {"url": picture.url}})
    parts.append({"type": "text", "text": end})
    return {"role": "user", "content": parts}


def scene_words(scene: Scene, *, tracking: bool, shapes: bool) -> str:
    """Return caption, objects, and the tracked poses of the first and last frame with their difference.

    Args:
        scene: what was understood of the video.
        tracking: tell the poses.
        shapes: tell shapes, sizes and masses; without them only caption, names and roles.
    """
    caption = f'The task is what this video shows: "{" ".join(scene.description.split())}".'
    if not shapes:
        rows = [f"| `{o.name}` | {o.label} | {o.role} |" for o in scene.objects]
        return "\n".join(
            [
                f"{caption} Nothing else of the video is known: no picture, no size, no motion.",
                "",
                "| object | in the caption | role |",
                "|---|---|---|",
                *rows,
            ]
        )
    lines = [
        caption,
        "",
        "| object | in the caption | role | shape | size x, y, z [m] | mass [kg] |",
        "|---|---|---|---|---|---|",
        *[_object_row(o) for o in scene.objects],
    ]
    tracked = [o for o in scene.objects if o.poses_world]
    if tracking and tracked:
        lines += [
            "",
            "Tracked poses of the video, in a frame with the same axes, its origin on the table "
            "under the first object's first "
            "place. Only differences carry over to the simulator. Tracking errs by a centimetre "
            "or two, in height by more.",
            "",
            "| object | frame | x, y, z [m] | qw, qx, qy, qz |",
            "|---|---|---|---|",
        ]
        for o in tracked:
            ends = o.frames or (0, scene.num_frames - 1)
            for frame, pose in ((ends[0], o.first_pose), (ends[-1], o.last_pose)):
                lines.append(
                    f"| `{o.name}` | {frame} | {_numbers(pose[:3])} | {_numbers(pose[3:])} |"
                )
            move, turn = (
                o.motion.translation_m,
                np.degrees(o.motion.rotation_vector_rad),
            )
            distance = float(np.linalg.norm(move))
            lines.append(
                f"| `{o.name}` | difference | {_numbers(move)}, {distance:.3f} in all | "
                f"turned by {np.linalg.norm(turn):.0f} degrees, axis times angle {_numbers(turn, 0)} |"
            )
    return "\n".join(lines)


def sample_words(index: int, count: int, idea: str) -> str:
    """Return what is said to one sample alone, so that the samples differ."""
    return (
        f"This is sample {index + 1} of {count}. So that the samples differ, let this one's "
        "reward follow this idea if it suits "
        f"the task: {idea}"
    )


def fault_message(fault: str, code: str) -> Message:
    """Return what is said about code that does not run: the error, and the line that it is about."""
    words = f"This code does not run: {fault}."
    found = LINE_OF_FAULT.search(fault)
    lines = code.splitlines()
    if found and 1 <= int(found[1]) <= len(lines):
        words += f"\nThat line is: `{lines[int(found[1]) - 1].strip()[:200]}`"
    return {
        "role": "user",
        "content": f"{words}\nSay in one sentence what is wrong, then answer in the same form as "
        "before, with everything.",
    }


def objection_message(table: str) -> Message:
    """Return what is said about code that runs but that the audit does not accept, as are all the others."""
    return {
        "role": "user",
        "content": f"This code runs, but an audit of its success function found fault with it:\n\n{table}\n\n"
        "Say which condition is wrong or missing and why, then answer in the same form as before, "
        "with everything. Do not "
        "fit numbers to the audit: say what must be true.",
    }


# --- the pick ------------------------------------------------------------------------------------------------


PICK = """\
Below are {count} codes for the task "{task}"{audited}.

{scene}

Judge each code by
- correctness: read and analyse the success part. Does it say what the caption says{agrees}?
- reasonability: avoid code that assumes scalar values or states that nothing gives, thresholds out of proportion to the
  objects, and successes that a touch or a fling would satisfy.
- efficiency: will a policy learn quickly from this reward and these observations?{errs}

{candidates}

Compare the codes in a few sentences. Then end with one line of JSON and nothing after it:
{{"index": <one of {indices}>, "correctness": "<why>", "reasonability": "<why>", "efficiency": "<why>"}}"""


AUDITED = """, each with the table of an audit: its success function was evaluated on the
video's own tracked poses, at simulated resets and on made-up moments that must not count"""
AUDIT_ERRS = (
    "\nThe audit can err about noise in the tracking (a wrong last pose), hardly about the rest."
)


def pick_message(
    scene: Scene, candidates: dict[int, tuple[str, Audit]], *, tracking: bool, shapes: bool
) -> Message:
    """Return the question which of some codes is the best, with their audit tables where the video may be told of."""
    shown = [
        f"## Code {i}\n\n"
        + f"{audit_table(verdict)}\n\n" * shapes
        + f"```python\n{code.strip()}\n```"
        for i, (code, verdict) in candidates.items()
    ]
    text = PICK.format(
        count=len(candidates),
        task=" ".join(scene.description.split()),
        audited=AUDITED * shapes,
        agrees=", and does the audit agree" * shapes,
        errs=AUDIT_ERRS * shapes,
        scene=scene_words(scene, tracking=tracking, shapes=shapes),
        candidates="\n\n".join(shown),
        indices=", ".join(map(str, candidates)),
    )
    return {"role": "user", "content": text}


def audit_table(verdict: Audit) -> str:
    """Return an audit as Markdown."""
    lines = [
        f"Audit: score {verdict.score:.2f} of 1 (acceptable from {ACCEPTABLE_SCORE}); {verdict.vetoed or 'no veto'}."
    ]
    if verdict.true_from_pose is not None:
        lines.append(f"True on the video from tracked pose {verdict.true_from_pose} on.")
    if verdict.threshold_m is not None:
        lines.append(f"Becomes true after {verdict.threshold_m:.3f} m of the video's motion.")
    lines += ["", "| question | answer | measured | weight |", "|---|---|---|---|"]
    for check in verdict.checks:
        weight = "veto" if check.is_veto else f"{check.weight:g}"
        lines.append(
            f"| {check.asks} | {'yes' if check.passed else 'NO'} | {check.share:.3g} | {weight} |"
        )
    lines += [f"Warning: {note}." for note in verdict.notes]
    return "\n".join(lines)


# --- rewards -------------------------------------------------------------------------------------------------


REFINEMENT = """\
Example {number} of a refinement: {task}. The reward was

```python
{before}
```

A policy was trained with it. What was seen:

{seen}

Thoughts: {thoughts}

```python
{after}
```

{came_to}"""


def first_reward_question(code: str) -> str:
    """Return the question for another reward of a task that was not trained yet."""
    return (
        f"Its code:\n\n```python\n{code.strip()}\n```\n\n"
        "Write another reward_function for it, of another design than this one: think of which steps lead to success, "
        f"and which component pulls the policy through each.\n\n{REWARD_FORMAT}"
    )


def better_reward_question(code: str, feedback: str) -> str:
    """Return the question for a better reward, given what training with this one showed."""
    return (
        f"Its code:\n\n```python\n{code.strip()}\n```\n\n"
        f"A policy was trained with this reward. What was seen:\n\n{feedback.strip()}\n\n"
        "Analyse each component first: what do its values in successful and in failed episodes "
        "say? A component that hardly "
        "changes is to be rescaled, given another temperature, rewritten or dropped; one that is far larger than the "
        "others is to be scaled down; one that is highest in failed episodes leads astray; a missing step needs a "
        "component. Successful episodes must earn more than failed ones. If nothing succeeded, design the reward anew. "
        f"Then write the better reward_function.\n\n{REWARD_FORMAT}"
    )


def _object_row(o: SceneObject) -> str:
    hollow = ", hollow" if o.hollow else ""
    return f"| `{o.name}` | {o.label} | {o.role} | {o.shape}{hollow} | {_numbers(o.size_m)} | {o.mass_kg:.2f} |"


def _numbers(values: Sequence[float] | np.ndarray, digits: int = 3) -> str:
    return ", ".join(f"{float(v) + 0.0:.{digits}f}" for v in values)


def _listed(names: frozenset[str]) -> str:
    return ", ".join(sorted(names))
