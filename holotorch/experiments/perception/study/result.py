"""One trial's result as the page sends it: what is in it, checked before it reaches the log."""

from typing import Any

from holotorch.experiments.perception.study.log import is_number


def checked_result(result: Any) -> tuple[int, str, dict[str, Any]]:
    """Index, window and measured values of what a page sent as a result, times in seconds.

    Raises:
        ValueError: It is not a result, or holds values that cannot be measured.
    """
    if not isinstance(result, dict) or type(result.get("index")) is not int or result["index"] < 0:
        raise ValueError("expected a result with the index of its trial")
    if not isinstance(result.get("window"), str):
        raise ValueError("expected the name of the window")
    values: dict[str, float | None] = {}
    for name in ("onset_s", "frame_s", "response_s"):
        value = result.get(name)
        if value is None and name == "response_s":
            values[name] = None
        elif not is_number(value) or value < 0:
            raise ValueError(f"{name}: expected seconds, got {str(value)[:20]}")
        else:
            values[name] = float(value)
    response, onset = values["response_s"], values["onset_s"]
    if not values["frame_s"]:
        raise ValueError("frame_s: expected more than 0 seconds")
    reaction = None if response is None or onset is None else round(response - onset, 6)
    if reaction is not None and reaction < 0:
        raise ValueError("response_s: expected a time after onset_s")
    counts = {name: result.get(name, 0) for name in ("early", "dropped_frames")}
    if any(type(count) is not int or count < 0 for count in counts.values()):
        raise ValueError("early, dropped_frames: expected counts")
    device = result.get("device")
    if device not in (None, "key", "pointer", "gamepad"):
        raise ValueError("device: expected key, pointer or gamepad")
    return (
        result["index"],
        result["window"],
        {"responded": response is not None, **values, "reaction_s": reaction, **counts, "device": device},
    )
