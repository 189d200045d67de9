"""Train ACT of LeRobot on exports, and measure how far its actions depend on touch."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from torch.utils.data import DataLoader

NAME = "touchdown/check"
CHUNK, RATE = 5, 1e-3
POSE = 7  # values of the pose at the front of observation.state
TOUCH = ("observation.markers", "observation.ft", "observation.environment_state")


def change_without_touch(root: Path, steps: int, batch: int) -> tuple[float, float]:
    """Train ACT on the dataset ``root``, then set all touch signals to zero.

    Returns the largest change of an action (position in m, quaternion), and the standard deviation
    of the actions of the dataset, averaged over their components.
    """
    torch.manual_seed(0)
    meta = LeRobotDatasetMetadata(NAME, root=root)
    spans = {"action": [k / meta.fps for k in range(CHUNK)]}
    dataset = LeRobotDataset(NAME, root=root, delta_timestamps=spans)
    settings = ACTConfig(
        chunk_size=CHUNK, n_action_steps=1, dim_model=64, n_heads=4, dim_feedforward=128,
        n_encoder_layers=2, n_vae_encoder_layers=1, latent_dim=8, pretrained_backbone_weights=None,
        device="cpu", push_to_hub=False,
    )  # fmt: skip
    policy = make_policy(settings, ds_meta=meta)
    before, after = make_pre_post_processors(settings, dataset_stats=meta.stats)
    optimiser = torch.optim.AdamW(policy.parameters(), RATE)
    policy.train()
    for rows in _rows(dataset, steps, batch):
        loss, _ = policy.forward(before(rows))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    def actions(rows: dict[str, Any]) -> torch.Tensor:
        return after(policy.predict_action_chunk(before(dict(rows))))

    changes = []
    for rows in _rows(dataset, 4, batch):
        without = {key: torch.zeros_like(v) if key in TOUCH else v for key, v in rows.items()}
        state = rows["observation.state"].clone()
        state[:, POSE:] = 0.0
        without["observation.state"] = state
        changes.append(float((actions(without) - actions(rows)).abs().max()))
    return max(changes), float(torch.as_tensor(meta.stats["action"]["std"]).mean())


def _rows(dataset: LeRobotDataset, steps: int, batch: int) -> Iterable[dict[str, Any]]:
    """Return this number of random batches."""
    drawn = torch.utils.data.RandomSampler(dataset, num_samples=steps * batch, replacement=True)
    return DataLoader(dataset, batch, sampler=drawn)
