"""Fingerprint of a run: the settings and digests of the inputs to which its checkpoint belongs."""

import hashlib
import json
from collections.abc import Collection, Mapping
from typing import Any

import torch
from pydantic import BaseModel
from torch import Tensor

_HASHED_BYTES = 64 << 20  # limit for a tensor; hashing that many bytes takes 0.1 s
_PREFIX = "blake2b:"  # distinguishes digests from other values

Fingerprint = dict[str, Any]


def fingerprint(
    settings: BaseModel, inputs: Mapping[str, tuple[Tensor | bytes | str, ...]], free: Collection[str] = ()
) -> Fingerprint:
    """Settings and inputs that determine a result, as plain JSON values by keys such as "modulator.sigma_px".

    Args:
        settings: The resolved configuration.
        inputs: Contents of input files by the key of the setting that names the file. The digest of the contents
            replaces that setting, since the path of a file does not matter.
        free: Keys that may change before a run is resumed.
    """
    excluded = tuple(f"{key}." for key in (*inputs, *free))
    flat = _flat(settings.model_dump(mode="json"))
    kept = {key: value for key, value in flat.items() if not f"{key}.".startswith(excluded)}
    return json.loads(json.dumps(kept | {key: _digest(parts) for key, parts in inputs.items()}))


def differences(before: Fingerprint, now: Fingerprint) -> list[str]:
    """A description of each key in which two fingerprints differ; a missing key, of another version, counts as None."""
    lines = []
    for key in sorted({*before, *now}):
        old, new = (values.get(key, "nothing") for values in (before, now))
        if before.get(key) != now.get(key):
            is_file = str(old).startswith(_PREFIX)
            lines.append(f"{key} has other contents" if is_file else f"{key} was {_short(old)} and is {_short(new)}")
    return lines


def _digest(parts: tuple[Tensor | bytes | str, ...]) -> str:
    """Digest of inputs; of a tensor above 64 MiB, only evenly spaced slices along the first axis are hashed."""
    total = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, Tensor):
            total.update(f"{tuple(part.shape)} {part.dtype}".encode())
            tensor = part.detach().reshape(1) if part.ndim == 0 else part.detach()
            count = min(len(tensor), max(2, _HASHED_BYTES // max(1, tensor.nbytes // max(1, len(tensor)))))
            for i in torch.linspace(0, len(tensor) - 1, count, dtype=torch.float64).round().long().tolist():
                total.update(tensor[i].contiguous().reshape(-1).cpu().view(torch.uint8).numpy().data)
        else:
            total.update(part.encode() if isinstance(part, str) else part)
        total.update(b"\0")
    return _PREFIX + total.hexdigest()


def _flat(value: Any, key: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {key: value}
    return {k: v for name, part in value.items() for k, v in _flat(part, f"{key}.{name}" if key else name).items()}


def _short(value: Any) -> str:
    text = value if value == "nothing" else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
