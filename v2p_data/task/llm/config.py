"""Settings of the model that writes task code; `vlm` is the client that keeps to them."""

import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

HOW = (
    "base_url",
    "key_env",
    "token_limit_name",
    "connect_timeout_s",
    "timeout_s",
    "max_retries",
    "parallel",
    "max_money",
    "max_total_tokens",
    "max_total_s",
    "price_in_per_million",
    "price_out_per_million",
    "mode",
    "calls",
)
"""Settings that change nothing about what is asked."""


@dataclass(frozen=True, kw_only=True)
class VlmConfig:
    """Which model writes task code, what it may cost, and what it is shown."""

    base_url: str = "https://api.openai.com/v1"
    """Where the chat-completions protocol is spoken, without `/chat/completions`."""
    model: str = "gpt-4o"
    """The model's name at that server; it must be able to see, unless `images` is off."""
    key_env: str = "OPENAI_API_KEY"
    """NAME of the environment variable that holds the key, never the key; empty where the server wants none."""
    temperature: float | None = 1.0
    """High enough that eight samples differ; none: not sent, for models that refuse it."""
    max_tokens: int = 6000
    """Length of one answer: a task code of 300 lines and the thoughts before it."""
    token_limit_name: Literal["max_tokens", "max_completion_tokens"] = "max_tokens"
    """What the server calls that limit: OpenAI's reasoning models want the second."""
    connect_timeout_s: float = 10.0
    """Until the server takes the connection."""
    timeout_s: float = 180.0
    """The longest silence of the server: answers come in one piece, so until the answer."""
    max_retries: int = 6
    """Further tries of one request after a busy server or a broken line, with waits as the
    `openai` package has them."""
    max_reasks: int = 2
    """Times a cut-off, empty, refused or code-free answer is asked for again."""
    max_regenerations: int = 3
    """Times one sample that does not run is sent back with its error."""
    parallel: int = 4
    """Requests at the same time."""
    max_money: float | None = 5.0
    """Stop when the folder's calls have cost this much, in the currency of the prices; none: no limit."""
    max_total_tokens: int | None = None
    """Stop when the folder's calls took this many tokens; none: no limit."""
    max_total_s: float | None = None
    """Stop when the folder's calls were waited for this long together; none: no limit."""
    price_in_per_million: float = 2.5
    """Price of a million tokens sent; GPT-4o's list price in dollars. Look yours up; 0 for a model of your own."""
    price_out_per_million: float = 10.0
    """Price of a million tokens received."""
    images: bool = True
    """Send pictures of the scene; off for models without eyes. With `tracking` off too, only
    caption and names are told."""
    tracking: bool = True
    """Send the tracked poses of the first and last frame; off for the ablation without tracking."""
    image_side_px: int = 768
    """Longer side of a picture that is sent: GPT-4o's own tiles are 768 high."""
    sheet_frames: int = 9
    """Moments on the contact sheet."""
    num_examples: int = 2
    """Solved tasks shown beside *reach a block* and *grasp a block*, the most alike first."""
    pick: Literal["vlm", "audit"] = "vlm"
    """Who chooses among the samples; the audit's veto stands either way."""
    mode: Literal["live", "replay"] = "live"
    """`replay` answers from stored calls alone; `live` asks for those that are not stored."""
    calls: Path | None = None
    """Folder in and below which calls are looked for and into which they are written; without one the caller's."""
    pool: Path | None = None
    """Folder of solved tasks of other runs, to be shown as examples too."""

    @property
    def tells_shapes(self) -> bool:
        """Tell sizes, shapes and masses: they come from the video too, and are hidden where nothing of it is told."""
        return self.images or self.tracking

    def recipe(self) -> "VlmConfig":
        """Return the settings that decide what is asked; those of how, how long and for how much are the defaults."""
        how = {f.name: f.default for f in fields(self) if f.name in HOW}
        return replace(self, **how)

    def __post_init__(self) -> None:
        url = urlsplit(self.base_url)
        if url.scheme not in ("http", "https") or not url.hostname:
            raise ValueError(
                "base_url must be an address such as https://api.openai.com/v1 or http://localhost:8000/v1"
            )
        if url.username or url.password or url.query or url.fragment:
            raise ValueError(
                "base_url may hold no user name, password or '?...': it is written to disk; "
                "put the key into the environment variable that key_env names"
            )
        if self.key_env and not re.fullmatch(r"[A-Z_][A-Z0-9_]{0,63}", self.key_env):
            raise ValueError(
                "key_env must be the NAME of an environment variable in capitals, such as OPENAI_API_KEY "
                "(what was given is not shown, in case it is the key itself)"
            )
        if not self.model:
            raise ValueError("model must not be empty; give the model's name at the server")
        for name in ("max_tokens", "parallel", "image_side_px", "sheet_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in (
            "max_retries",
            "max_reasks",
            "max_regenerations",
            "num_examples",
            "price_in_per_million",
            "price_out_per_million",
        ):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not (self.timeout_s > 0 and self.connect_timeout_s > 0):
            raise ValueError("timeout_s and connect_timeout_s must be above 0")
        if self.mode == "replay" and self.calls is None:
            raise ValueError(
                "mode 'replay' needs calls: the folder that holds the stored calls or a run that made them"
            )
