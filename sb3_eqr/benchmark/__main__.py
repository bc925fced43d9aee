"""The command line: ``sb3-eqr benchmark run|status|report|pack``. The help needs none of the extra's packages."""

import importlib
import pathlib
import sys

from sb3_eqr.common.checks.arguments import SuggestingParser

SEEDS = 5  # default
SUITES = "atari100k, atari100k-5, minatar, classic, worlds, mujoco, smoke, smoke-atari"
EXAMPLE = "example: sb3-eqr benchmark run results/first --suite smoke --agents eqr_qrdqn eqr_qrdqn:off --seeds 2"


def make_parser() -> SuggestingParser:
    """:return: the parser of the commands"""
    parser = SuggestingParser(prog="sb3-eqr benchmark", description="Compare agents by the scores of several seeds.")
    commands = parser.add_subparsers(dest="command", required=True)
    about = "train and evaluate agents on a suite; the same command resumes where it stopped"
    run = commands.add_parser("run", help=about, description=about, epilog=EXAMPLE)
    # An absolute path is valid on every machine of a cluster.
    run.add_argument("folder", type=lambda path: pathlib.Path(path).resolve(), help="output folder")
    run.set_defaults(default_seeds=SEEDS)  # apart from --seeds, which shows whether it was given
    run.add_argument("--suite", help=f"{SUITES}, or one from --suite-file")
    run.add_argument("--suite-file", type=pathlib.Path, help="a YAML file with suites of your own")
    run.add_argument("--agents", nargs="+", help="such as eqr_qrdqn, eqr_qrdqn:off (no EqR), qrdqn:stock, eqr_rainbow:se2+aet")
    run.add_argument("--gym-packages", nargs="+", default=[], help="packages that register environments with gymnasium")
    run.add_argument("--games", nargs="+", help="a subset of the suite's games (default: all)")
    run.add_argument("--seeds", help=f"number of seeds, or the seeds themselves, such as 1,3 (default: {SEEDS})")
    run.add_argument("--first-seed", type=int, default=0, help="where the number of seeds counts from (default: 0)")
    run.add_argument("--steps", type=int, help="training steps instead of the suite's")
    run.add_argument("--episodes", type=int, help="episodes of the final evaluation instead of the suite's")
    run.add_argument("--device", default="auto", help="PyTorch device (default: cpu)")
    run.add_argument("--jobs", type=int, help="runs at once (default: the cores divided by --cpus-per-run)")
    run.add_argument("--cpus-per-run", type=float, default=1.0, help="CPUs and PyTorch threads per run (default: 1)")
    run.add_argument("--stop-after", type=float, metavar="SECONDS", help="then checkpoint and stop; the same command resumes")
    run.add_argument(
        "--ray", nargs="?", const="local", metavar="ADDRESS", help="run on Ray: on the cluster at ADDRESS, or on this machine"
    )
    run.add_argument("--gpus-per-run", type=float, default=0.0, help="with --ray: GPUs per run, such as 0.1 (default: 0)")
    run.add_argument("--save-models", action="store_true", help="save each trained agent in models/ of its run, for enjoy -f")
    run.add_argument(
        "--checkpoint-every", type=float, default=300.0, metavar="SECONDS", help="time between checkpoints (default: 300)"
    )
    status = commands.add_parser("status", help="progress of a benchmark")
    status.add_argument("folder", type=pathlib.Path)
    report = commands.add_parser("report", help="write scores, tables, figures and report.html")
    report.add_argument(
        "folders", nargs="+", type=pathlib.Path, metavar="folder", help="folders of benchmarks, or files of packed runs"
    )
    report.add_argument(
        "--reference", action="append", default=[], metavar="NAME=FILE", help="own scores: a JSON file, game -> scores of runs"
    )
    report.add_argument("--agents", nargs="+", default=[], help="a subset of the agents (default: all)")
    report.add_argument("--baseline", help="the agent to compare the others with (default: a stock one, or one without EqR)")
    report.add_argument(
        "--force", action="store_true", help="compare despite different protocols or missing games; the report marks them"
    )
    report.add_argument("--output", type=pathlib.Path, help="output folder (default: FOLDER/report; NAME_report for a file)")
    pack = commands.add_parser("pack", help="add the finished and stopped runs of a benchmark to one compressed file")
    pack.add_argument("folder", type=pathlib.Path)
    pack.add_argument("file", type=pathlib.Path, help="NAME.jsonl.xz")
    return parser


def main() -> None:
    """Parse the command line and run the command."""
    args = make_parser().parse_args()
    try:
        execute = importlib.import_module("sb3_eqr.benchmark.commands").execute
    except ImportError as error:
        sys.exit(f'sb3-eqr benchmark: {error}. Run pip install ".[benchmark]" in a clone of the repository')
    execute(args)


if __name__ == "__main__":
    main()
