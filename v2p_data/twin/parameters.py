"""The numbers of the twin: one draw per field from a fixed seed, made before any policy was scored in it.

Every field has a stream of its own, so a new field changes no other. Sweeps replace single fields of `nominal()` by
`dataclasses.replace`. What differs in mechanism is not here but in the modules that use these numbers.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.seeds import rng_for

TWIN_SEED = 20261125
"""Seed of the nominal twin. Nobody tunes on it: a test pins the digest of what it draws."""


def _drawn(low: float, high: float, source: str, count: int = 0) -> Any:
    """Return a field that is drawn uniformly; `count` above 0 makes it a tuple of independent draws."""
    return field(metadata={"low": low, "high": high, "source": source, "count": count})


@dataclass(frozen=True, kw_only=True)
class TwinParameters:
    """One twin. Units are in the names; ranges and their sources are in the fields' metadata."""

    # Objects and table
    contact_time_s: float = _drawn(0.004, 0.008, "time constant of contacts, 2 to 4 time steps")
    mass_scale: float = _drawn(0.75, 1.35, "masses are estimated from volumes")
    object_friction_scale: float = _drawn(0.75, 1.25, "friction is estimated from materials")
    size_scale: float = _drawn(0.97, 1.03, "reconstruction error of objects' sizes")
    table_friction: float = _drawn(0.4, 0.9, "wood and cardboard on wood")
    table_height_m: float = _drawn(-0.0015, 0.0015, "levelling of a table against the arm's base")
    pad_friction: float = _drawn(0.7, 1.1, "rubber on cardboard and plastic")
    # Arm
    reference_gain_hz: float = _drawn(
        14.0, 22.0, "Cartesian error to reference speed [1/s]; lag of 45 to 70 ms"
    )
    speed_share: float = _drawn(0.5, 0.8, "share of Franka's limits of joint speed")
    stiffness_scale: float = _drawn(0.8, 1.2, "of Franka's example joint impedance gains")
    damping_scale: float = _drawn(0.8, 1.2, "of Franka's example joint impedance gains")
    motor_lag_s: float = _drawn(0.001, 0.003, "first-order lag from commanded to applied torque")
    joint_friction_nm: float = _drawn(0.2, 0.6, "Coulomb friction left after compensation")
    armature_scale: float = _drawn(0.8, 1.2, "reflected rotor inertia against the arm's own model")
    backlash_rad: float = _drawn(1e-4, 4e-4, "play between encoder and link")
    joint_offset_rad: tuple[float, ...] = _drawn(-4e-4, 4e-4, "zero error of each encoder", 7)
    gravity_compensation: float = _drawn(0.98, 1.02, "error of the arm's own mass model")
    mount_pos_m: tuple[float, ...] = _drawn(-5e-4, 5e-4, "gripper against calibrated mount", 3)
    mount_rad: tuple[float, ...] = _drawn(-3e-3, 3e-3, "gripper against calibrated mount", 3)
    # Gripper
    gripper_speed_m_s: float = _drawn(0.07, 0.15, "opening; Robotiq 2F-85 manual: 20 to 150 mm/s")
    grip_force_n: float = _drawn(25.0, 50.0, "Robotiq 2F-85 manual: 20 to 235 N")
    gripper_deadband: float = _drawn(0.004, 0.015, "share of the stroke: 1 to 4 of 255 counts")
    # Latency
    command_latency_s: float = _drawn(0.010, 0.016, "controller cycle and network")
    reading_latency_s: float = _drawn(0.010, 0.016, "controller cycle and network")
    latency_jitter_s: float = _drawn(0.002, 0.004, "added to each of both, uniform from 0")
    camera_latency_s: float = _drawn(0.020, 0.045, "exposure and USB transfer at 30 frames/s")
    camera_jitter_s: float = _drawn(0.002, 0.010, "added to it, uniform from 0")
    # Camera: where it stands and what calibration says
    placement_m: tuple[float, ...] = _drawn(-0.008, 0.008, "set up by hand, per axis", 3)
    placement_rad: tuple[float, ...] = _drawn(-0.02, 0.02, "set up by hand, per axis", 3)
    calibration_m: tuple[float, ...] = _drawn(-0.003, 0.003, "hand-eye calibration error", 3)
    calibration_rad: tuple[float, ...] = _drawn(-0.004, 0.004, "hand-eye calibration error", 3)
    focal_scale: float = _drawn(0.98, 1.02, "lens against data sheet")
    centre_px: tuple[float, ...] = _drawn(-5.0, 5.0, "principal point of 480 px", 2)
    k1: float = _drawn(-0.12, -0.05, "barrel distortion of webcams")
    k2: float = _drawn(0.0, 0.03, "barrel distortion of webcams")
    calibration_focal_scale: float = _drawn(0.997, 1.003, "chessboard calibration error")
    calibration_centre_px: tuple[float, ...] = _drawn(-1.0, 1.0, "chessboard calibration error", 2)
    calibration_k_scale: float = _drawn(0.95, 1.05, "chessboard calibration error of k1 and k2")
    # Camera: sensor
    blur_px: float = _drawn(0.5, 0.9, "standard deviation of defocus at 480 px")
    vignette: float = _drawn(0.1, 0.3, "share of light lost in the corners")
    exposure: float = _drawn(0.85, 1.15, "automatic exposure")
    exposure_jitter: float = _drawn(0.01, 0.04, "standard deviation between episodes")
    white_balance: tuple[float, ...] = _drawn(0.93, 1.07, "gain of red, green, blue", 3)
    full_well: float = _drawn(2000.0, 8000.0, "electrons at white: shot noise of small sensors")
    read_noise: float = _drawn(0.5, 1.5, "standard deviation in grey levels")
    jpeg_quality: float = _drawn(80.0, 95.0, "MJPEG of USB cameras")
    # Light and table
    lamp_pos_m: tuple[float, ...] = _drawn(-0.5, 0.5, "from 1.6 m above the workspace", 3)
    lamp_scale: float = _drawn(0.8, 1.1, "brightness of the lamp")
    table_grey: float = _drawn(0.35, 0.75, "brightness of the table's colour")
    table_warmth: float = _drawn(0.0, 0.15, "more red and less blue by so much")
    grain: float = _drawn(0.05, 0.2, "contrast of the table's grain")

    def digest(self) -> str:
        """Return a SHA-256 of all values, rounded to 12 significant digits."""
        text = json.dumps(self.as_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def as_dict(self) -> dict[str, Any]:
        """Return all values for JSON, rounded to 12 significant digits."""
        return {
            name: [float(f"{v:.12g}") for v in value]
            if isinstance(value, tuple)
            else float(f"{value:.12g}")
            for name, value in asdict(self).items()
        }


def draw(seed: int) -> TwinParameters:
    """Return the twin of a seed."""
    values: dict[str, Any] = {}
    for f in fields(TwinParameters):
        rng, m = rng_for(seed, "twin", f.name), f.metadata
        if m["count"]:
            values[f.name] = tuple(rng.uniform(m["low"], m["high"], m["count"]).tolist())
        else:
            values[f.name] = float(rng.uniform(m["low"], m["high"]))
    return TwinParameters(**values)


def nominal() -> TwinParameters:
    """Return the twin that results are reported for."""
    return draw(TWIN_SEED)


def changed(change: Mapping[str, float]) -> TwinParameters:
    """Return the nominal twin with other values of some single numbers, for sweeps.

    Raises:
        V2PError: there is no such number, or it cannot have such a value.
    """
    base = nominal()
    single = [f.name for f in fields(base) if not f.metadata["count"]]
    for name, value in change.items():
        if name not in single:
            raise V2PError(f"the twin has no single number '{name}'.{did_you_mean(name, single)}")
        low, high = _possible(name)
        if not low <= value <= high:  # also where it is no number
            raise V2PError(f"the twin's {name} lies between {low:g} and {high:g}, got {value}")
    return replace(base, **change)


def _possible(name: str) -> tuple[float, float]:
    """Return the bounds of what a number may be at all: wide, for sweeps until nothing works."""
    if name in _BOUNDS:
        return _BOUNDS[name]
    low = {f.name: f.metadata["low"] for f in fields(TwinParameters)}[name]
    return (0.0, 1e3) if low >= 0 else (-1.0, 1.0)


_BOUNDS = {
    "contact_time_s": (0.004, 0.1),
    "mass_scale": (0.01, 100.0),
    "size_scale": (0.5, 2.0),
    "reference_gain_hz": (0.5, 40.0),
    "speed_share": (0.01, 1.0),
    "stiffness_scale": (0.1, 3.0),
    "damping_scale": (0.1, 3.0),
    "motor_lag_s": (0.0, 0.01),
    "armature_scale": (0.2, 5.0),
    "gripper_speed_m_s": (0.005, 1.0),
    "grip_force_n": (1.0, 235.0),
    "gripper_deadband": (0.0, 0.5),
    "command_latency_s": (0.0, 2.0),
    "reading_latency_s": (0.0, 2.0),
    "camera_latency_s": (0.0, 2.0),
    "focal_scale": (0.95, 1.05),
    "calibration_focal_scale": (0.8, 1.2),
    "blur_px": (0.1, 10.0),
    "vignette": (0.0, 1.0),
    "full_well": (10.0, 1e6),
    "jpeg_quality": (1.0, 100.0),
}
"""Bounds of numbers that may not be zero, or beyond which nothing is simulated faithfully."""


def episode_rng(seed: int, what: str) -> np.random.Generator:
    """Return the stream of one kind of noise in the episode of this seed, e.g. `latency`."""
    return rng_for(TWIN_SEED, "twin", "episode", seed, what)
