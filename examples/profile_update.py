"""
Which operations an update of EqRQRDQN on Atari frames spends its time in, by PyTorch's profiler.

    python examples/profile_update.py [--threads 1] [--updates 20] [--rows 25]
"""

import argparse

import torch as th
from torch.profiler import ProfilerActivity, profile

from sb3_eqr.benchmark.speed.workload import EQR_AGENTS, make_trainable


def main() -> None:
    """Parse the command line, profile, print."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--rows", type=int, default=25)
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    model = make_trainable(EQR_AGENTS[0])
    model.train(gradient_steps=10, batch_size=model.batch_size)
    with profile(activities=[ProfilerActivity.CPU]) as profiled:  # without shapes: to keep them takes fresh memory
        model.train(gradient_steps=args.updates, batch_size=model.batch_size)
    rows = sorted(profiled.key_averages(), key=lambda row: -row.self_cpu_time_total)
    total = sum(row.self_cpu_time_total for row in rows)
    print(f"{total / args.updates / 1e3:.1f} ms per update, {sum(row.count for row in rows) / args.updates:,.0f} operations")
    print(f"{'operation':40}{'calls':>7}{'ms':>8}{'share':>8}")
    for row in rows[: args.rows]:
        milliseconds = row.self_cpu_time_total / args.updates / 1e3
        print(f"{row.key[:39]:40}{row.count / args.updates:7.1f}{milliseconds:8.2f}{row.self_cpu_time_total / total:8.1%}")


if __name__ == "__main__":
    main()
