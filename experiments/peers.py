"""
The tests of the installed versions of SB3 and sb3-contrib, run with our agents in place of theirs: EqRQRDQN replaces QRDQN,
EqRRainbow replaces DQN. The source archives are downloaded from the package index. Exits with 1 if a test fails and
no reason for it is listed.

    python -m experiments.peers --out docs/results/peers.md
"""

import argparse
import importlib.metadata
import pathlib
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ET

SUITES = {"sb3-contrib": ("EqRQRDQN", "sb3_contrib.QRDQN"), "stable-baselines3": ("EqRRainbow", "stable_baselines3.DQN")}
COPIED = (
    "it expects a target network that differs from the online one; the defaults copy it after every update, as the paper does"
)
BUFFER = "it looks at the arrays of SB3's own replay buffer; ours stores each frame once"
TRUNK = "it looks for a layer of a custom features extractor, which is at features_extractor.trunk here"
HER = "hindsight replay uses its own buffer, without the sequences that the losses need"
WARNINGS = (
    "it expects other warnings: optimize_memory_usage has no effect here, and its unseeded agent may find returns outside "
    "of C51's support"
)
MODULES = {"test_her": HER, "test_n_step_replay": "it expects SB3's own buffer for n-step returns"}
REASONS = {  # tests, without their parameters
    "test_feature_extractor_target_net": COPIED,
    "test_features_extractor_target_net": COPIED,
    "test_image_like_input": "it normalises integer images with VecNormalize, which is refused with a ValueError that says "
    "what to pass: SB3 would store their terminal observations as other images",
    "test_consistency": "MlpPolicy starts with a dense layer that MultiInputPolicy does not have",
    "test_save_load_replay_buffer": BUFFER,
    "test_offpolicy_collect_rollout_batch_norm": TRUNK,
    "test_predict_with_dropout_batch_norm": TRUNK,
    "test_fps_logger": "it expects 100 steps per second, but each step includes two updates",
    "test_offpolicy_multi_env": "it expects updates after 3 steps, before a window of 10 steps is complete",
    "test_warn_buffer": WARNINGS,
}


def fetch(package: str, folder: pathlib.Path) -> pathlib.Path:
    """:return: the unpacked source archive of the version that is installed"""
    wanted = f"{package}=={importlib.metadata.version(package)}"
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-binary", ":all:", "--dest", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "download", *options, wanted], check=True)
    (archive,) = folder.glob(f"{package.replace('-', '_')}-*.tar.gz")
    with tarfile.open(archive) as content:
        content.extractall(folder, filter="data")
    return folder / archive.name.removesuffix(".tar.gz")


def run(package: str, folder: pathlib.Path) -> dict[str, list[str]]:
    """:return: "passed", "failed" and "skipped" -> names of tests"""
    agent, place = SUITES[package]
    module, name = place.split(".")
    (folder / "swap.py").write_text(f"import {module}\nfrom sb3_eqr import {agent}\n\n{module}.{name} = {agent}\n")
    report = folder / f"{package}.xml"
    command = [sys.executable, "-m", "pytest", "-p", "swap", "tests", "-k", agent, "-q", f"--junitxml={report}"]
    environment = {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "HOME": str(folder)}
    subprocess.run(command, cwd=fetch(package, folder), env=environment, stdout=subprocess.DEVNULL)
    found: dict[str, list[str]] = {"passed": [], "failed": [], "skipped": []}
    for case in ET.parse(report).iter("testcase"):
        kinds = {child.tag for child in case}
        outcome = "skipped" if "skipped" in kinds else "failed" if kinds & {"failure", "error"} else "passed"
        found[outcome].append(f"{case.get('classname', '').removeprefix('tests.')}: {case.get('name')}")
    return found


def main() -> None:
    """Parse the command line, run the tests, print and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, help="the Markdown page to write")
    args = parser.parse_args()
    lines = ["# The tests of SB3 and sb3-contrib", "", " ".join(__doc__.split("\n\n")[0].split()), "", "```sh"]
    lines += [
        "python -m experiments.peers --out docs/results/peers.md",
        "```",
        "",
        "| suite | agent | passed | skipped | failed |",
    ]
    lines.append("|---|---|---|---|---|")
    failed: list[str] = []
    for package, (agent, _) in SUITES.items():
        with tempfile.TemporaryDirectory() as folder:
            found = run(package, pathlib.Path(folder))
        counts = " | ".join(str(len(found[outcome])) for outcome in ("passed", "skipped", "failed"))
        lines.append(f"| {package} {importlib.metadata.version(package)} | {agent} | {counts} |")
        failed += found["failed"]
    lines += ["", "The tests that fail, and why:", ""]
    unexplained = []
    for test in failed:
        module, _, name = test.partition(": ")
        reason = MODULES.get(module) or REASONS.get(name.partition("[")[0])
        unexplained += [] if reason else [test]
        lines.append(f"- `{test}`: {reason or '**no reason is known**'}.")
    text = "\n".join([*lines, ""])
    print(text)
    if args.out is not None:
        args.out.write_text(text, encoding="utf-8")
    raise SystemExit(1 if unexplained else 0)


if __name__ == "__main__":
    main()
