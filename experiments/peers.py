"""
The tests of the installed versions of SB3 and sb3-contrib, run with our agents in place of theirs: EqRQRDQN replaces QRDQN,
EqRRainbow DQN, EqRSAC SAC, EqRTQC TQC. The source archives are downloaded from the package index. Exits with 1 if a test
fails and no reason for it is listed.

    python -m experiments.peers --out experiments/notes/peers.md
"""

import argparse
import importlib.metadata
import pathlib
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ET

import yaml

from experiments import markdown

SUITES = [  # package, agent, the one that it replaces
    ("sb3-contrib", "EqRQRDQN", "QRDQN"),
    ("sb3-contrib", "EqRTQC", "TQC"),
    ("stable-baselines3", "EqRRainbow", "DQN"),
    ("stable-baselines3", "EqRSAC", "SAC"),
]
FILE = pathlib.Path(__file__).with_name("settings") / "peers.yml"
REASONS: dict[str, str] = yaml.safe_load(FILE.read_text(encoding="utf-8"))


def fetch(package: str, folder: pathlib.Path) -> pathlib.Path:
    """:return: the unpacked source archive of the version that is installed"""
    wanted = f"{package}=={importlib.metadata.version(package)}"
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-binary", ":all:", "--dest", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "download", *options, wanted], check=True)
    (archive,) = folder.glob(f"{package.replace('-', '_')}-*.tar.gz")
    with tarfile.open(archive) as content:
        content.extractall(folder, filter="data")
    return folder / archive.name.removesuffix(".tar.gz")


def run(package: str, agent: str, replaced: str, folder: pathlib.Path) -> dict[str, list[str]]:
    """:return: "passed", "failed" and "skipped" -> names of tests"""
    module = package.replace("-", "_")
    (folder / "swap.py").write_text(f"import {module}\nfrom sb3_eqr import {agent}\n\n{module}.{replaced} = {agent}\n")
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
    rows, reasons, unexplained = [], [], 0
    for package, agent, replaced in SUITES:
        with tempfile.TemporaryDirectory() as folder:
            found = run(package, agent, replaced, pathlib.Path(folder))
        counts = [str(len(found[outcome])) for outcome in ("passed", "skipped", "failed")]
        rows.append([f"{package} {importlib.metadata.version(package)}", agent, *counts])
        for test in found["failed"]:
            module, _, name = test.partition(": ")
            function = name.partition("[")[0]
            reason = REASONS.get(f"{agent} {function}") or REASONS.get(module) or REASONS.get(function)
            unexplained += reason is None
            reasons.append(f"- `{test}`: {reason or '**no reason is known**'}.")
    about = " ".join(__doc__.split("\n\n")[0].split())
    command = "```sh\npython -m experiments.peers --out experiments/notes/peers.md\n```"
    counted = markdown(["suite", "agent", "passed", "skipped", "failed"], rows)
    parts = [
        "# The tests of SB3 and sb3-contrib",
        about,
        command,
        counted,
        "The tests that fail, and why:",
        "\n".join(reasons),
    ]
    text = "\n\n".join(parts) + "\n"
    print(text)
    if args.out is not None:
        args.out.write_text(text, encoding="utf-8")
    raise SystemExit(1 if unexplained else 0)


if __name__ == "__main__":
    main()
