"""The client for any server that speaks the chat-completions protocol: GPT-4o, vLLM, Ollama and the like.

`VlmClient.ask` returns an answer or raises one sentence. The `openai` package waits and tries again where a server is
busy or a line breaks. The client asks again with the fault told where an answer is of no use, counts tokens, money and
time, stops at a budget, and stores every call (`calls`), so that a run can be repeated without network. The key of the
API is read from the environment, sent, and written nowhere.
"""

import functools
import json
import logging
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.task.llm.calls import Call, CallStore, Usage, call_key, without_pictures
from v2p_data.task.llm.config import VlmConfig

logger = logging.getLogger(__name__)

Message = dict[str, Any]
"""`{"role": ..., "content": text or a list of text and picture parts}`."""
SHORTEST_SECRET = 8
"""Shorter values of the key's variable (`none`, `EMPTY`) are placeholders for servers that want no key."""
LETTERS_PER_TOKEN = 4
TOKENS_PER_PICTURE = 800


class BudgetError(V2PError):
    """The money, tokens or time that were allowed are used up."""


class UnusableAnswersError(V2PError):
    """The model answered, and none of its answers could be used."""


class FaultyAnswerError(Exception):
    """An answer that is of no use, in words that tell the model what to do about it."""


Reader = Callable[[str], Any]
"""Takes what is wanted out of an answer's text; raises `FaultyAnswerError` where it is not there."""


class VlmClient:
    """Asks one model, from several threads if wanted.

    Args:
        cfg: which one, and limits.
        calls: folder for the calls, where `cfg.calls` names none.
        seed: another one asks anew instead of taking stored answers.

    Raises:
        V2PError: the key's environment variable is not set, or the `openai` package is missing.
    """

    def __init__(self, cfg: VlmConfig, calls: Path, seed: int) -> None:
        self.cfg = cfg
        self.seed = seed
        key = _key(cfg)
        self.store = CallStore(cfg.calls or calls, hide=key if len(key) >= SHORTEST_SECRET else "")
        self.spent = Usage()
        """By this client, stored answers not counted."""
        self._lock = threading.Lock()
        self._openai = _connect(cfg, key) if cfg.mode == "live" else None

    def ask(
        self, messages: list[Message], purpose: str, read: Reader
    ) -> tuple[Any, list[Message]]:
        """Return what `read` takes out of the answer, and the conversation with the answer at its end.

        An answer that is cut off, empty or refused, or that `read` finds fault with, is asked for again with the
        fault told, `max_reasks` times.

        Args:
            messages: the conversation; not changed.
            purpose: what it is for, in a few words; equal questions with different purposes get answers of their own.
            read: takes what is wanted out of the text.

        Raises:
            FaultyAnswerError: no answer was of use.
            BudgetError: the budget is used up.
            V2PError: the server cannot be asked.
        """
        talk = list(messages)
        for turn in range(self.cfg.max_reasks + 1):
            call = self._answered(talk, f"{purpose}, asked again {turn}" if turn else purpose)
            try:
                wanted = read(_useful_text(call))
            except FaultyAnswerError as fault:
                logger.info("%s: answer %d is of no use: %s", purpose, turn + 1, fault)
                if turn == self.cfg.max_reasks:
                    raise
                talk = [*talk, _said(call), {"role": "user", "content": str(fault)}]
            else:
                return wanted, [*talk, _said(call)]
        raise AssertionError("unreachable")

    # -- one call

    def _answered(self, messages: list[Message], purpose: str) -> Call:
        """Return the call's answer, from the store if it is there."""
        request: dict[str, Any] = {
            "model": self.cfg.model,
            "messages": messages,
            self.cfg.token_limit_name: self.cfg.max_tokens,
        }
        if self.cfg.temperature is not None:
            request["temperature"] = self.cfg.temperature
        key = call_key(request, f"{purpose}, seed {self.seed}")
        call = self.store.find(key)
        if call is None:
            if self._openai is None:
                raise V2PError(
                    f"replay: {self.store.folder} holds no answer to '{purpose}' (call {key}); replay needs the calls "
                    "of the same code, scene, settings and seed, or take --task.vlm.mode=live to ask the model"
                )
            self._check_budget()
            call = self._asked(request, key, purpose)
            self.store.write(call, request)
            with self._lock:
                self.spent += call.usage
        return call

    def _asked(self, request: dict[str, Any], key: str, purpose: str) -> Call:
        """Send the question, and return the answer once it has come and holds a choice."""
        import openai

        assert self._openai is not None
        begin = time.monotonic()
        try:
            reply = self._openai.chat.completions.with_raw_response.create(**request)
        except openai.APIStatusError as error:
            body = error.body
            words = str(body.get("message") or body) if isinstance(body, dict) else str(body)
            raise V2PError(
                f"{self.cfg.base_url} refuses the request for model '{self.cfg.model}'; it "
                f"answered {error.status_code}: "
                f"{self.store.shown(' '.join(words.split())[:300])}"
            ) from error
        except openai.APIConnectionError as error:
            cause = error.__cause__ or error
            raise V2PError(
                f"{self.cfg.base_url} gave no answer in {self.cfg.max_retries + 1} tries ({type(cause).__name__}). "
                "Is the server up? --task.vlm.max-retries and --task.vlm.timeout-s give it more time"
            ) from error
        try:
            data = json.loads(reply.text)
            choice = data["choices"][0]
            message = choice["message"]
            content = message.get("content")
        except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
            raise V2PError(
                f"what came back from {self.cfg.base_url} is no chat completion ({type(error).__name__}); does the "
                "address lead to such a server? --task.vlm.base-url names it"
            ) from error
        if isinstance(content, list):  # some servers send parts
            content = "".join(str(p.get("text", "")) for p in content if isinstance(p, dict))
        return Call(
            key=key,
            purpose=purpose,
            request=without_pictures(request),
            answer=content if isinstance(content, str) else "",
            finish_reason=str(choice.get("finish_reason") or ""),
            refusal=str(message.get("refusal") or ""),
            usage=self._usage(data, request, time.monotonic() - begin),
            attempts=1 + reply.retries_taken,
            model=str(data.get("model") or ""),
        )

    # -- what it takes

    def _usage(self, data: dict[str, Any], request: dict[str, Any], seconds: float) -> Usage:
        counted = data.get("usage")
        try:
            sent = int(counted["prompt_tokens"])  # pyright: ignore[reportOptionalSubscript]
            received = int(counted["completion_tokens"])  # pyright: ignore[reportOptionalSubscript]
            estimated = 0
        except (TypeError, KeyError, ValueError):
            bare = json.dumps(without_pictures(request))
            sent = len(bare) // LETTERS_PER_TOKEN + TOKENS_PER_PICTURE * bare.count(".jpg")
            received = len(json.dumps(data["choices"][0])) // LETTERS_PER_TOKEN
            estimated = 1
        money = sent * self.cfg.price_in_per_million + received * self.cfg.price_out_per_million
        return Usage(
            calls=1,
            prompt_tokens=sent,
            completion_tokens=received,
            money=money / 1e6,
            seconds=seconds,
            estimated=estimated,
        )

    def _check_budget(self) -> None:
        total = self.store.spent()
        for name, used, allowed in (
            ("max-money", total.money, self.cfg.max_money),
            ("max-total-tokens", total.tokens, self.cfg.max_total_tokens),
            ("max-total-s", total.seconds, self.cfg.max_total_s),
        ):
            if allowed is not None and used >= allowed:
                raise BudgetError(
                    f"the calls in {self.store.folder} used {used:.4g} of the {allowed:g} that --task.vlm.{name} "
                    f"allows, after {total.calls} calls; raise it to go on, the answers that were paid for are kept"
                )


def _key(cfg: VlmConfig) -> str:
    if cfg.mode == "replay" or not cfg.key_env:
        return ""
    key = os.environ.get(cfg.key_env, "").strip()
    if not key:
        raise V2PError(
            f"the environment variable {cfg.key_env} with the key for {cfg.base_url} is not set; set it, name another "
            "with --task.vlm.key-env=NAME, or give an empty name for a server that wants no key"
        )
    return key


def _connect(cfg: VlmConfig, key: str) -> Any:
    try:
        import openai
    except ImportError as error:
        raise V2PError(
            "--task.writer=vlm needs the openai package: run 'make setup' in the repository"
        ) from error
    return openai.OpenAI(
        base_url=cfg.base_url,
        api_key=key or "not-needed",
        timeout=openai.Timeout(cfg.timeout_s, connect=cfg.connect_timeout_s),
        max_retries=cfg.max_retries,
        http_client=_connections(),
    )


@functools.cache
def _connections() -> Any:
    """Return the connections of this process; every client of it shares them."""
    import openai

    return openai.DefaultHttpxClient()


def _useful_text(call: Call) -> str:
    """Return the answer without a reasoning model's thoughts.

    Raises:
        FaultyAnswerError: it is refused, cut off or empty.
    """
    if call.refusal or call.finish_reason == "content_filter":
        raise FaultyAnswerError(
            "You refused. This is a robot arm in a physics simulation that moves everyday objects "
            "on a table; nobody can "
            "come to harm. Please answer the question as asked."
        )
    if call.finish_reason == "length":
        raise FaultyAnswerError(
            f"Your answer was cut off after {call.usage.completion_tokens} tokens. Answer again "
            "from the start and much "
            "shorter: at most five sentences of thought, and code without long comments."
        )
    text = re.sub(r"<think>.*?</think>", "", call.answer, flags=re.DOTALL).strip()
    if not text:
        raise FaultyAnswerError("Your answer was empty. Please answer the question as asked.")
    return text


def _said(call: Call) -> Message:
    """Return the answer as a turn; of a cut-off one its beginning, which is not worth paying for twice."""
    text = call.answer if call.finish_reason != "length" else call.answer[:200] + " ..."
    return {"role": "assistant", "content": text or call.refusal or "(nothing)"}
