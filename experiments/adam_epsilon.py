"""
How large the gradients of the online network are, compared with the epsilon of Adam. Adam divides the mean gradient of each
entry by the root of its mean square plus epsilon: where epsilon is larger, the step is as much smaller.

    python -m experiments.adam_epsilon --games SpaceInvaders Freeway ALE/Pong --agents eqr_rainbow eqr_qrdqn --updates 2000

Per weight matrix: the root mean square of its gradients, from Adam's own running means, in the median over its entries; and
the share of its entries for which that is below epsilon.
"""

import argparse
from typing import Any

import torch as th

from experiments.trials import WORLDS, make_agent
from sb3_eqr import envs


def magnitudes(model: Any) -> dict[str, tuple[float, float]]:
    """
    :param model: an EqR agent that has been trained with Adam
    :return: weight matrix -> median over its entries of the gradient's root mean square, share of them below epsilon
    """
    found = {}
    optimizer = model.policy.optimizer
    settings = optimizer.param_groups[0]
    for name, parameter in model.policy.online.named_parameters():
        state = optimizer.state.get(parameter)
        if state and name.endswith("weight") and parameter.ndim > 1:
            mean_square = state["exp_avg_sq"] / (1 - settings["betas"][1] ** float(state["step"]))
            root = mean_square.sqrt()
            found[name] = root.median().item(), (root < settings["eps"]).float().mean().item()
    return found


def main() -> None:
    """Parse the command line, train the agents, print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", nargs="+", required=True, help=f"of MinAtar, ALE/Pong, ..., {', '.join(WORLDS)}")
    parser.add_argument("--agents", nargs="+", default=["eqr_rainbow"], help="files of zoo_hyperparams")
    parser.add_argument("--updates", type=int, default=2_000)
    args = parser.parse_args()
    th.set_num_threads(1)
    envs.register()
    print("| game | agent | weights | gradient | share below Adam's ε |\n|---|---|---|---|---|")
    for game in args.games:
        for agent in args.agents:
            starts, per_step = 1_000, {"gradient_steps": 1, "train_freq": 1}
            steps = starts + args.updates
            model = make_agent(agent, game, 0, {"buffer_size": steps, "learning_starts": starts, **per_step})
            model.learn(steps)
            for name, (median, below) in magnitudes(model).items():
                print(f"| {game} | {agent} | {name} | {median:.1e} | {below:.2f} |", flush=True)


if __name__ == "__main__":
    main()
