"""Batch-Constrained Q-learning in plain PyTorch, to which BCQLoss is compared.

Fujimoto et al. 2019, https://arxiv.org/abs/1812.02900, algorithm 1, without the perturbation
network and without tensordict or TorchRL. The networks equal those of ``torchrl_bmrl.modules``.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn


def mlp(in_features: int, out_features: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(in_features, width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.ReLU(),
        nn.Linear(width, out_features),
    )


class VAE(nn.Module):
    """Posterior q(z | s, a) and decoder G(s, z)."""

    def __init__(self, observation_dim: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.latent_dim = 2 * action_dim
        self.encoder = mlp(observation_dim + action_dim, 2 * self.latent_dim, width)
        self.decoder = mlp(observation_dim + self.latent_dim, action_dim, width)

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        hidden = self.encoder(torch.cat([observation, action], -1))
        mean, log_std = hidden.chunk(2, -1)
        std = log_std.clamp(-4.0, 15.0).exp()
        latent = mean + std * torch.randn_like(std)
        return self.decode(observation, latent), mean, std

    def decode(self, observation: Tensor, latent: Tensor) -> Tensor:
        return self.decoder(torch.cat([observation, latent], -1)).tanh()


class Critic(nn.Module):
    def __init__(self, observation_dim: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.network = mlp(observation_dim + action_dim, 1, width)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.network(torch.cat([observation, action], -1))


class PlainBCQ:
    """Networks, optimizers and one update."""

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        width: int = 256,
        num_candidates: int = 10,
        lmbda: float = 0.75,
        latent_clip: float = 0.5,
        kl_weight: float = 0.5,
        gamma: float = 0.99,
        tau: float = 0.005,
        lr: float = 1e-3,
        device: str = "cpu",
    ) -> None:
        self.num_candidates, self.lmbda, self.latent_clip = num_candidates, lmbda, latent_clip
        self.kl_weight, self.gamma, self.tau = kl_weight, gamma, tau
        self.vae = VAE(observation_dim, action_dim, width).to(device)
        self.critic_1 = Critic(observation_dim, action_dim, width).to(device)
        self.critic_2 = Critic(observation_dim, action_dim, width).to(device)
        self.target_1 = deepcopy(self.critic_1).requires_grad_(False)
        self.target_2 = deepcopy(self.critic_2).requires_grad_(False)
        self.vae_optimizer = torch.optim.Adam(self.vae.parameters(), lr=lr)
        self.critic_optimizer = torch.optim.Adam(
            [*self.critic_1.parameters(), *self.critic_2.parameters()], lr=lr
        )

    def vae_loss(self, observation: Tensor, action: Tensor) -> Tensor:
        reconstruction, mean, std = self.vae(observation, action)
        error = (reconstruction - action).square().mean()
        divergence = 0.5 * (mean.square() + std.square() - 1.0) - std.log()
        return error + self.kl_weight * divergence.mean()

    def critic_loss(
        self,
        observation: Tensor,
        action: Tensor,
        reward: Tensor,
        next_observation: Tensor,
        terminated: Tensor,
    ) -> Tensor:
        rows = observation.shape[0]
        with torch.no_grad():
            repeated = next_observation.repeat_interleave(self.num_candidates, 0)
            latent = torch.randn(repeated.shape[0], self.vae.latent_dim, device=repeated.device)
            latent = latent.clamp(-self.latent_clip, self.latent_clip)
            proposals = self.vae.decode(repeated, latent)
            q_1, q_2 = self.target_1(repeated, proposals), self.target_2(repeated, proposals)
            mixed = self.lmbda * torch.min(q_1, q_2) + (1.0 - self.lmbda) * torch.max(q_1, q_2)
            value = mixed.reshape(rows, -1).max(1, keepdim=True)[0]
            target = reward + self.gamma * (~terminated) * value
        error_1 = (self.critic_1(observation, action) - target).square().mean()
        return error_1 + (self.critic_2(observation, action) - target).square().mean()

    def update_targets(self) -> None:
        pairs = ((self.critic_1, self.target_1), (self.critic_2, self.target_2))
        for critic, target in pairs:
            for source, moving in zip(critic.parameters(), target.parameters(), strict=True):
                moving.data.lerp_(source.data, self.tau)

    def update(
        self,
        observation: Tensor,
        action: Tensor,
        reward: Tensor,
        next_observation: Tensor,
        terminated: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """One update in the published order: VAE, critics, targets."""
        vae_loss = self.vae_loss(observation, action)
        self.vae_optimizer.zero_grad(set_to_none=True)
        vae_loss.backward()
        self.vae_optimizer.step()

        critic_loss = self.critic_loss(observation, action, reward, next_observation, terminated)
        self.critic_optimizer.zero_grad(set_to_none=True)
        critic_loss.backward()
        self.critic_optimizer.step()

        self.update_targets()
        return vae_loss.detach(), critic_loss.detach()
