"""What a module learns and what it keeps: one rule for the values and tensors that a module is built from."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn


class PreciseModule(nn.Module):
    """Base class of modules that compute in float64 whatever the dtype of their input.

    What the module learns are Parameters, see :meth:`hold`. What follows from its arguments, such as a kernel, is
    neither in ``state_dict`` nor among its buffers, which ``DistributedDataParallel`` would send to every process in
    every step. ``.to`` moves everything to another device; neither ``.to`` nor ``.float()`` changes a dtype.
    """

    def __init__(self):
        super().__init__()
        self._kept: tuple[str, ...] = ()

    def keep(self, name: str, values: Tensor | None) -> None:
        """Keep a tensor that follows from the arguments as an attribute that moves with the module."""
        without_graph(name, values)
        self._kept = (*(kept for kept in self._kept if kept != name), name)
        setattr(self, name, values)

    def hold(self, name: str, value: Tensor | float | tuple[float, ...], *, learnable: bool = False) -> bool:
        """Set ``self.name`` to ``value`` and return whether it is learned.

        An ``nn.Parameter`` is registered as it is, and may be shared with other modules. With ``learnable``, any other
        value becomes a new Parameter, float64 if it is real. Otherwise the attribute is ``value`` itself.

        Raises ValueError as :func:`without_graph`.
        """
        without_graph(name, value)
        if isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
            return True
        if not learnable:
            setattr(self, name, value)
            return False
        values = value.detach().clone() if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
        self.register_parameter(name, nn.Parameter(values if values.is_complex() else values.double()))
        return True

    def record(self, name: str, value: Tensor | float, *, learnable: bool = False) -> bool:
        """As :meth:`hold`, but a value that is not learned becomes a buffer, and is in ``state_dict`` as well."""
        learned = self.hold(name, value, learnable=learnable)
        if not learned:
            delattr(self, name)
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64).clone())
        return learned

    def adopt(self, name: str, settings: Any) -> bool:
        """Keep a dataclass as ``self.name``, register the Parameters among its fields, and return if there are any.

        They are registered as ``name_field``, or ``name_field_key`` for a field that is a mapping.
        """
        setattr(self, name, settings)
        parameters = dict(_parameters(name, settings))
        for each, parameter in parameters.items():
            self.register_parameter(each, parameter)
        return bool(parameters)

    def present(self, name: str) -> Any:
        """The adopted dataclass with the module's present Parameters, which ``functional_call`` may have replaced."""
        settings, learned = getattr(self, name), {}
        for field in dataclasses.fields(settings):
            value, own = getattr(settings, field.name), f"{name}_{field.name}"
            if isinstance(value, nn.Parameter):
                learned[field.name] = getattr(self, own)
            elif isinstance(value, Mapping) and any(isinstance(each, nn.Parameter) for each in value.values()):
                learned[field.name] = {
                    k: getattr(self, f"{own}_{k}") if isinstance(v, nn.Parameter) else v for k, v in value.items()
                }
        if not learned:
            return settings
        present = object.__new__(type(settings))  # as copy.copy, which torch.compile cannot follow until torch 2.11
        for field in dataclasses.fields(settings):
            value = learned.get(field.name, getattr(settings, field.name))
            object.__setattr__(present, field.name, value)
        return present

    def _apply(self, fn, recurse=True):
        def moved(tensor: Tensor) -> Tensor:
            # Only the device is asked of ``fn``: a cast would drop the imaginary parts of complex numbers.
            return tensor.to(fn(torch.empty(0, device=tensor.device)).device)

        for name in self._kept:
            values = getattr(self, name)
            setattr(self, name, values if values is None else moved(values))
        return super()._apply(moved, recurse)


def _parameters(name: str, settings: Any) -> Iterator[tuple[str, nn.Parameter]]:
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        entries = value if isinstance(value, Mapping) else {"": value}
        for key, each in entries.items():
            if isinstance(each, nn.Parameter):
                yield f"{name}_{field.name}" + (f"_{key}" if isinstance(value, Mapping) else ""), each


def without_graph(name: str, value: object) -> None:
    """Raise ValueError if ``value`` is a tensor that requires a gradient and is not an ``nn.Parameter``.

    A module that kept it would keep its graph, which can neither be copied nor be used for a second backward pass.
    """
    if isinstance(value, Tensor) and value.requires_grad and not isinstance(value, nn.Parameter):
        raise ValueError(
            f"{name} requires a gradient, but a module keeps no graph: give an nn.Parameter, or {name}.detach() with "
            "learnable=True"
        )


def fixed(name: str, value: object, instead: str) -> None:
    """Raise ValueError if ``value`` is a tensor that requires a gradient; ``instead`` says what to do."""
    if isinstance(value, Tensor) and value.requires_grad and torch.is_grad_enabled():
        raise ValueError(f"{name} requires a gradient, which would be lost here: {instead}")
