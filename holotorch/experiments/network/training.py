"""Training of a PhaseUNet: pictures, loss through the display, checkpoints, and several processes."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, DistributedSampler, RandomSampler
from tqdm import tqdm

from holotorch.correction import PECProblem
from holotorch.experiments.runs.signals import delayed
from holotorch.io.files import replacing
from holotorch.io.images import load_image


class Crops(Dataset[Tensor]):
    """Crops of photographs as light with a mean of 1, float32 [1, size, size], with different positions and mirroring.

    Args:
        sources: Names of bundled pictures, or paths.
        size: Pixels along a side.
        count: Number of crops; crop k is the same in every epoch.
        seed: Of the positions of the crops.
    """

    def __init__(self, sources: Sequence[str | Path], size: int, count: int, seed: int = 0):
        self.size, self.count, self.seed = size, count, seed
        self.pictures = [_halved(load_image(source).mean(0).float(), 2 * size) for source in sources]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Tensor:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + index)
        picture = self.pictures[index % len(self.pictures)]
        # The same for every access.
        top, left = (int(torch.randint(n - self.size + 1, (), generator=generator)) for n in picture.shape)
        crop = picture[top : top + self.size, left : left + self.size]
        crop = crop.flip(-1) if index % 2 else crop
        return (crop / crop.mean().clamp(min=1e-3))[None]


def _halved(picture: Tensor, minimum: int) -> Tensor:
    """``picture`` [H, W] at half its resolution as often as both sides stay at least ``minimum`` pixels."""
    while min(picture.shape) >= 2 * minimum:
        picture = nn.functional.avg_pool2d(picture[None], 2)[0]
    return picture


def train(
    network: nn.Module,
    problem: PECProblem,
    pictures: Dataset[Tensor],
    *,
    steps: int,
    batch: int = 8,
    rate: float = 1e-3,
    autocast: bool = False,
    checkpoint: Path | None = None,
) -> list[float]:
    """Train ``network`` by AdamW on the loss of ``problem``, and return the losses of all steps.

    The rate falls to 0 as half a cosine. In a process group every process takes its share of each batch of pictures,
    so that the result is that of one process. With ``checkpoint`` the state is saved every 100 steps, and a training
    that finds such a file continues from it.

    Args:
        network: From targets [B, C, H, W] to phases.
        problem: Without a target of its own.
        pictures: Targets [C, H, W].
        steps: Number of steps.
        batch: Pictures of one step, over all processes.
        rate: First learning rate.
        autocast: Compute the convolutions in bfloat16; phases and light stay in float32.
        checkpoint: Path of the file, or None.
    """
    together = torch.distributed.is_available() and torch.distributed.is_initialized()
    share = batch // torch.distributed.get_world_size() if together else batch
    parallel = nn.parallel.DistributedDataParallel(network) if together else network
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    losses: list[float] = []
    if checkpoint is not None and checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        schedule.load_state_dict(state["schedule"])
        losses = state["losses"]
    per_epoch = len(pictures) // batch  # type: ignore[arg-type]
    device = next(network.parameters()).device
    progress = tqdm(total=steps, initial=len(losses), desc="training", unit="step", disable=None)
    while len(losses) < steps:
        epoch = len(losses) // per_epoch
        for k, target in enumerate(_epoch(pictures, share, epoch, together)):
            if k < len(losses) % per_epoch and k < len(losses) - epoch * per_epoch:
                continue  # trained on before the checkpoint
            if len(losses) >= steps or k >= per_epoch:
                break
            target = target.to(device)
            optimiser.zero_grad()
            with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
                phase = parallel(target)
            loss = problem(phase, target).mean() / target[0, 0].numel()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
            progress.update()
            progress.set_postfix(loss=f"{losses[-1]:.4f}")
            if checkpoint is not None and len(losses) % 100 == 0:
                _save(checkpoint, network, optimiser, schedule, losses)
    progress.close()
    return losses


def _epoch(pictures: Dataset[Tensor], batch: int, seed: int, together: bool) -> DataLoader[Tensor]:
    """The pictures of one epoch in a random order, this process's share if there are several."""
    if together:
        sampler = DistributedSampler(pictures, shuffle=True, seed=seed, drop_last=True)
    else:
        sampler = RandomSampler(pictures, generator=torch.Generator().manual_seed(seed))  # type: ignore[arg-type]
    return DataLoader(pictures, batch, sampler=sampler, drop_last=True)


def _save(path: Path, network: nn.Module, optimiser, schedule, losses: list[float]) -> None:
    if torch.distributed.is_available() and torch.distributed.is_initialized() and torch.distributed.get_rank():
        return
    state = {"network": network.state_dict(), "optimiser": optimiser.state_dict(),
             "schedule": schedule.state_dict(), "losses": losses}  # fmt: skip
    with delayed(), replacing(path) as stream:
        torch.save(state, stream)
