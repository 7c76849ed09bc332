"""The colours of a film become those of a plain screen, BT.709 at 8 bits, as a player without HDR shows them.

Numbers of matrices, transfer functions and primaries are those of ITU-T H.273, which libav uses too.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from jaxtyping import Float, UInt8, UInt16

_UNSAID = 2
_MATRICES = {1: "BT.709", 4: "FCC", 7: "SMPTE 240M", 9: "BT.2020", 10: "BT.2020"}
"""Those that a scaler has to be told of; 5 and 6, BT.601, are what it takes where nothing is said."""
_UNKNOWN_MATRICES = {
    8: "YCgCo",
    11: "Y'D'zD'x",
    12: "chroma derived",
    13: "chroma derived",
    14: "ICtCp",
    15: "IPT",
}
_PQ, _HLG = 16, 18
_TRANSFERS = {_PQ: "PQ", _HLG: "HLG"}
_WIDE = {9: "BT.2020", 11: "P3", 12: "P3"}
_TO_BT709 = {
    "BT.2020": [
        [1.6605, -0.5876, -0.0728],
        [-0.1246, 1.1329, -0.0083],
        [-0.0182, -0.1006, 1.1187],
    ],
    "P3": [[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]],
}
"""Linear light of wide primaries, white D65, in BT.709's. Source: BT.2407, annex 2; SMPTE EG 432-1."""
_WHITE_NITS = 203.0
"""HDR reference white: what a plain screen shows as white. Source: BT.2408, table 1."""
_GAMMA = 2.4
"""Of a plain screen. Source: BT.1886."""


@dataclass(frozen=True, kw_only=True)
class Colours:
    """How the colours of one film are to be read."""

    matrix: int
    transfer: int
    primaries: int
    is_full: bool
    """Whether brightness goes from 0 to 255, not from 16 to 235."""

    @staticmethod
    def of(frame: VideoFrame, stream: VideoStream) -> "Colours":
        """Return what a decoded frame and its stream say; wide colours where HDR says nothing of them."""
        said = stream.codec_context
        is_hdr = said.color_trc in _TRANSFERS
        return Colours(
            matrix=frame.colorspace,
            transfer=said.color_trc,
            primaries=9 if is_hdr and said.color_primaries == _UNSAID else said.color_primaries,
            is_full=frame.color_range == ColorRange.JPEG
            and not frame.format.name.startswith("yuvj"),
        )

    @property
    def note(self) -> str:
        """Return what a person should know; empty where nothing had to be done to the colours."""
        if self.matrix in _UNKNOWN_MATRICES:
            return f"has its colours as {_UNKNOWN_MATRICES[self.matrix]}, which is not converted; export it as BT.709"
        hdr, wide = _TRANSFERS.get(self.transfer), _WIDE.get(self.primaries)
        kinds = [f"HDR ({hdr})"] * bool(hdr) + [f"the wide colours of {wide}"] * bool(wide)
        return f"has {' and '.join(kinds)}, converted to BT.709" if kinds else ""

    @property
    def is_plain(self) -> bool:
        return self.transfer not in _TRANSFERS and self.primaries not in _WIDE

    @property
    def reformat(self) -> dict[str, Any]:
        """Return what to tell a scaler, which knows of a frame's range and matrix by itself only sometimes."""
        if self.matrix not in _MATRICES and not self.is_full:
            return {}
        return {
            "src_colorspace": self.matrix if self.matrix in _MATRICES else Colorspace.ITU601,
            "dst_colorspace": Colorspace.ITU601,
            "src_color_range": ColorRange.JPEG if self.is_full else None,
        }

    def on_screen(self, pixels: UInt16[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return what a plain screen shows of R'G'B' of 16 bits; what is brighter than its white is white."""
        light = self._light[pixels]
        if self.transfer == _HLG:  # the eye of a screen of 1000 cd/m2. Source: BT.2100, table 5
            light *= (light @ np.array([0.2627, 0.6780, 0.0593], np.float32))[..., None] ** 0.2
            light *= 1000 / _WHITE_NITS
        if wide := _WIDE.get(self.primaries):
            light = light @ np.array(_TO_BT709[wide], np.float32).T
        return (255 * light.clip(0, 1) ** (1 / _GAMMA) + 0.5).astype(np.uint8)

    @cached_property
    def _light(self) -> Float[np.ndarray, "65536"]:
        """Light of each signal: of HLG that of the scene, else that of the screen, reference white is 1."""
        signal = np.linspace(0, 1, 65536)
        if self.transfer == _PQ:  # Source: BT.2100, table 4
            root = signal ** (32 / 2523)
            light = (np.maximum(root - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * root)) ** (
                8192 / 1305
            )
            light *= 10000 / _WHITE_NITS
        elif self.transfer == _HLG:  # Source: BT.2100, table 5
            a, b, c = 0.17883277, 0.28466892, 0.55991073
            light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        else:
            light = signal**_GAMMA
        return light.astype(np.float32)
