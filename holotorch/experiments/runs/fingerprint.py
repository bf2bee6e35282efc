"""Which configuration and which inputs a checkpoint belongs to, so that no run goes on with those of another."""

import hashlib
import json
from collections.abc import Collection, Mapping
from typing import Any

import torch
from pydantic import BaseModel
from torch import Tensor

_MOST = 64 << 20  # bytes that are looked at of one tensor: a tenth of a second
_MARK = "blake2b:"

Fingerprint = dict[str, Any]


def fingerprint(
    settings: BaseModel, inputs: Mapping[str, tuple[Tensor | bytes | str, ...]], free: Collection[str] = ()
) -> Fingerprint:
    """Settings and inputs that determine a result, as plain JSON values by their keys, such as "modulator.sigma_px".

    Args:
        settings: The resolved configuration.
        inputs: What was read, by the key of its settings, which are left out: it counts what a file holds, not where it
            lies.
        free: Keys that may change before a run goes on.
    """
    left = {*inputs, *free}
    flat = _flat(settings.model_dump(mode="json"))
    kept = {key: value for key, value in flat.items() if not any(f"{key}.".startswith(f"{name}.") for name in left)}
    return json.loads(json.dumps(kept | {key: _digest(parts) for key, parts in inputs.items()}))


def differences(before: Fingerprint, now: Fingerprint) -> list[str]:
    """Each key in which two fingerprints differ, in words."""
    found = []
    for key in sorted({*before, *now}):
        was, is_ = (each.get(key, "nothing") for each in (before, now))
        if was != is_:
            other = str(was).startswith(_MARK)
            found.append(f"{key} holds another content" if other else f"{key} was {_said(was)} and is {_said(is_)}")
    return found


def _digest(parts: tuple[Tensor | bytes | str, ...]) -> str:
    """Of a tensor of more than 64 MiB slices that lie evenly along its first axis, the first and last of them."""
    total = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, Tensor):
            total.update(f"{tuple(part.shape)} {part.dtype}".encode())
            whole = part.detach().reshape(1) if part.ndim == 0 else part.detach()
            count = min(len(whole), max(2, _MOST // max(1, whole.nbytes // max(1, len(whole)))))
            for i in torch.linspace(0, len(whole) - 1, count, dtype=torch.float64).round().long().tolist():
                total.update(whole[i].contiguous().reshape(-1).cpu().view(torch.uint8).numpy().data)
        else:
            total.update(part.encode() if isinstance(part, str) else part)
        total.update(b"\0")
    return _MARK + total.hexdigest()


def _flat(value: Any, key: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {key: value}
    return {k: v for name, part in value.items() for k, v in _flat(part, f"{key}.{name}" if key else name).items()}


def _said(value: Any) -> str:
    text = value if value == "nothing" else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
