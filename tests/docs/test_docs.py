"""
README and docs/ are correct: Python blocks run, command lines can be parsed, files are valid, and every block is tested.

Sybil finds the blocks. Those of one page share a namespace and run in the order of the page, in an empty folder. So that a
page takes seconds, ``learn`` does 20 steps and learns from the 16th on, at least every fourth step, with at most two updates;
a PPO rollout has 8 steps, a game of Atari ends after 40 steps and an evaluation after one episode (see ``shortened``).
Nothing else is replaced.
"""

import argparse
import ast
import functools
import importlib
import json
import os
import pathlib
import re
import runpy
import shlex
import subprocess
import sys
import tempfile
import warnings
from types import SimpleNamespace

import huggingface_hub
import huggingface_sb3
import matplotlib
import pytest
import stable_baselines3.common.evaluation
import yaml
from sphinx.directives.code import LiteralIncludeReader
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from sybil import Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown.lexers import RawFencedCodeBlockLexer

import sb3_eqr.envs.atari
import sb3_eqr.visualize
import sb3_eqr.zoo.__main__ as zoo_command
import sb3_eqr.zoo.hub
from sb3_eqr import ExactCheckpointCallback, cli
from sb3_eqr.benchmark.agents import find_agent
from sb3_eqr.benchmark.suites import choose, load_suite, make_suite
from sb3_eqr.zoo import register
from sb3_eqr.zoo.entries import check_entry
from tests.tools.test_report import a_benchmark

ROOT = pathlib.Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(set(DOCS.rglob("*.md")) - set((DOCS / "_build").rglob("*")))]
STEPS, LEARNING_STARTS, TRAIN_FREQ, GRADIENT_STEPS, ROLLOUT, GAME_STEPS = 20, 16, 4, 2, 8, 40
INCLUDE_OPTIONS = {"pyobject", "start-at", "end-before", "dedent"}  # line numbers go stale
SHELL = ("git", "cd", ".")
# Of another version than the tested one, ``pip install -c constraints.txt`` would replace the CPU build by the one with CUDA.
(TESTED,) = re.findall(r"^torch==.+$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.M)
CPU_BUILD = (TESTED, "--index-url", "https://download.pytorch.org/whl/cpu")


def name_of(page):
    return str(page.relative_to(ROOT))


# --- kinds of blocks -----------------------------------------------------------------------------------------------------


def check_sh(example):
    for line in command_lines(example.parsed):
        check_command(line)


def check_yaml(example):
    """Hyperparameters have the key ``policy``, suites the key ``games``, changes of another file ``base`` and ``changes``."""
    register()  # RL Zoo knows our agents only then
    found = yaml.safe_load(example.parsed)
    if "base" in found:
        with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
            file.write(example.parsed)
            file.flush()
            assert find_agent(f"eqr_rainbow:{file.name}").changes == found["changes"]
        return
    for name, entry in found.items():
        if "games" in entry:
            make_suite(name, "docs", entry)
        else:
            check_entry(entry, "eqr_rainbow" if "rainbow" in example.path else "eqr_qrdqn", "docs")


def check_nothing(example):
    """Output, folders, drawings."""


def check_eval_rst(example):
    """Everything that autodoc shows exists and has a docstring."""
    for kind, name, options in re.findall(r"^\.\. auto(\w+):: (\S+)\n((?: +:.*\n)*)", f"{example.parsed}\n", re.M):
        module, _, attribute = name.rpartition(".")
        found = importlib.import_module(name) if kind == "module" else getattr(importlib.import_module(module), attribute)
        assert found.__doc__, name
        for member in re.findall(r"[\w.]+", "".join(re.findall(r"^ +:members:(.*)$", options, re.M))):
            assert getattr(found, member).__doc__, f"{name}.{member}"


def check_literalinclude(example):
    """What it shows is a complete function or statement. Read with Sphinx's own reader."""
    options = dict(re.findall(r"^:([\w-]+): *(.*)$", example.parsed, re.M))
    assert options.keys() <= INCLUDE_OPTIONS
    options |= {key: int(options[key]) for key in options.keys() & {"dedent"}}
    code, _ = LiteralIncludeReader(str(included(example)), options, SimpleNamespace(source_encoding="utf-8")).read()
    assert ast.parse(code).body


def check_pages(example):
    """Every page of a table of contents exists."""
    folder = pathlib.Path(example.path).parent
    for line in example.parsed.splitlines():
        path = re.sub(r".* <(.*)>$", r"\1", line)  # Title <path>
        assert not path or path.startswith(":") or any((folder / f"{path}.{kind}").is_file() for kind in ("md", "ipynb")), line


def check_include(example):
    assert included(example).is_file()


def included(example):
    return pathlib.Path(example.path).parent / example.region.lexemes["info"].split("}")[1].strip()


BLOCKS = {
    "python": PythonEvaluator(),
    "sh": check_sh,
    "yaml": check_yaml,
    "text": check_nothing,
    "diff": check_nothing,
    "": check_nothing,
    "{eval-rst}": check_eval_rst,
    "{literalinclude}": check_literalinclude,
    "{toctree}": check_pages,
    "{include}": check_include,
}


def every_fence(document):
    """A parser for Sybil: every fenced block, with the evaluator of its language or directive."""
    for region in RawFencedCodeBlockLexer(re.compile(r"(?P<info>.*)$\n", re.M))(document):
        language = (region.lexemes["info"].split() or [""])[0]
        assert language in BLOCKS, f"{document.path}: BLOCKS has no check for blocks of {language!r}"
        region.parsed = region.lexemes["source"]
        region.evaluator = BLOCKS[language]
        yield region


def examples_of(page):
    return list(Sybil([every_fence]).parse(page).examples())


def without_blocks(text):
    return re.sub(r"^```.*?^```$", "", text, flags=re.S | re.M)


# --- command lines -------------------------------------------------------------------------------------------------------


class Understood(Exception):
    """Raised when a command has parsed its arguments and would start its work."""


def command_lines(text):
    """
    :return: the words of each line, without comments and environment variables
    """
    for line in text.replace("\\\n", " ").splitlines():
        line = re.sub(
            r"\{(\d+)\.\.(\d+)\}", lambda ends: " ".join(map(str, range(int(ends[1]), int(ends[2]) + 1))), line
        )  # bash
        words = shlex.split(line, comments=True)
        while words and re.match(r"[A-Z_]+=", words[0]):
            del words[0]
        if words:
            yield words


def check_command(words):
    """Fail unless the program, which is the first word, can parse the other words."""
    program, arguments = words[0], words[1:]
    assert all((ROOT / word).is_file() for word in words if word.startswith("docs/results/") and word.endswith(".xz")), words
    if program == "pip":
        check_pip(arguments)
    elif program == "make":
        check_make(arguments)
    elif words[:3] == ["python", "-m", "sb3_eqr.zoo"]:
        check_sb3_eqr(words[3:])
    elif program == "sb3-eqr":
        check_sb3_eqr(arguments)
    elif words[:2] == ["python", "-c"]:
        exec(words[2], {})
    elif words[:3] == ["python", "-m", "venv"]:
        assert len(words) == 4, words
    elif words[:2] == ["python", "-m"]:
        check_script(lambda: runpy.run_module(words[2], run_name="__main__"), words[3:])
    elif program == "python":
        assert pathlib.Path(words[1]).parent.name == "examples", words
        check_script(lambda: runpy.run_path(str(ROOT / words[1]), run_name="__main__"), words[2:])
    else:
        assert program in SHELL, f"there is no check for the command {program}"


def check_pip(arguments):
    assert arguments[0] == "install"
    extras = re.search(r"\[project.optional-dependencies\]\n(.*?)\n\[", (ROOT / "pyproject.toml").read_text(), re.S)[1]
    legal = re.findall(r"^([\w-]+) = \[", extras, re.M)
    for word in arguments[1:]:
        if match := re.match(r"(?:\.|sb3-eqr)\[(.*)\]$", word):
            assert set(match[1].split(",")) <= set(legal), word
        elif word.endswith(".txt"):
            assert (ROOT / word).is_file(), word
        else:
            assert word in (".", "-c", "-e", *CPU_BUILD), word


def check_make(arguments):
    makefile = (ROOT / "Makefile").read_text()
    for word in arguments:
        name, assigned, _ = word.partition("=")
        assert re.search(rf"^{name} \?=" if assigned else rf"^{name}:", makefile, re.M), word


def check_sb3_eqr(arguments):
    args = check_script(cli.main, arguments)  # RL Zoo's commands also check names, files and hyperparameters
    if arguments[:2] == ["benchmark", "run"] and args.suite is not None:
        if args.suite_file is None:
            choose(load_suite(args.suite), args.games, args.steps)
        for agent in args.agents:
            if "experiments/" in agent or ".yml" not in agent:  # other files are the reader's
                find_agent(agent.replace("experiments/", f"{ROOT}/experiments/"))


def check_script(call, arguments):
    """
    :param call: runs the script, which is stopped when it has parsed its arguments
    :return: the parsed arguments
    """
    with pytest.MonkeyPatch.context() as patch:
        parse_args = argparse.ArgumentParser.parse_args

        def parse_and_stop(self, args=None, namespace=None):
            raise Understood(parse_args(self, args, namespace))

        patch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
        for name in ("check_trained", "check_runs", "save_where_nothing_is_shown"):
            patch.setattr(zoo_command, name, lambda argument: None)  # nothing is trained here
        for module, name in ((huggingface_hub, "HfApi"), (huggingface_sb3, "load_from_hub")):  # commands replace them for good
            patch.setattr(module, name, getattr(module, name))
        patch.setattr("huggingface_sb3.push_to_hub.generate_metadata", None, raising=False)
        patch.setattr(sb3_eqr.zoo.hub, "provide_ffmpeg", lambda: None)
        patch.setattr(sys, "argv", ["command", *arguments])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # runpy warns about modules that are already imported
                call()
        except Understood as understood:
            return understood.args[0]
        except SystemExit as stopped:
            assert stopped.code == 0 and "--help" in arguments
            return None
        assert not arguments  # a script without arguments has run completely
        return None


# --- the tests -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def shortened(monkeypatch, tmp_path):
    """Training and evaluation take seconds, and the files that the pages read exist."""
    setup_learn, evaluate = BaseAlgorithm._setup_learn, stable_baselines3.common.evaluation.evaluate_policy

    def setup_short_learn(self, total_timesteps, *args, **kwargs):
        if isinstance(self, OffPolicyAlgorithm):
            starts = self.learning_starts  # None: an EqR agent's default
            self.learning_starts = LEARNING_STARTS if starts is None else min(starts, LEARNING_STARTS)
            self.gradient_steps = min(self.gradient_steps, GRADIENT_STEPS)
            self.train_freq = self.train_freq._replace(frequency=min(self.train_freq.frequency, TRAIN_FREQ))
        return setup_learn(self, min(total_timesteps, STEPS), *args, **kwargs)

    def set_up_short_rollouts(self):
        self.n_steps, self.batch_size = ROLLOUT, ROLLOUT
        setup_model(self)

    def evaluate_one(model, env, n_eval_episodes=10, **kwargs):
        return evaluate(model, env, n_eval_episodes=1, **kwargs)

    def check_often(self, *args, **kwargs):
        begin(self, *args, **kwargs)
        self.save_freq = min(self.save_freq, STEPS // 2)

    record = sb3_eqr.visualize.record

    @functools.wraps(record)
    def record_briefly(*args, **kwargs):
        return record(*args, **{**kwargs, "n_steps": 10})

    monkeypatch.setattr(sb3_eqr.visualize, "record", record_briefly)
    setup_model, begin = OnPolicyAlgorithm._setup_model, ExactCheckpointCallback.__init__
    monkeypatch.setattr(ExactCheckpointCallback, "__init__", check_often)
    monkeypatch.setattr(BaseAlgorithm, "_setup_learn", setup_short_learn)
    monkeypatch.setattr(OnPolicyAlgorithm, "_setup_model", set_up_short_rollouts)
    monkeypatch.setattr(stable_baselines3.common.evaluation, "evaluate_policy", evaluate_one)
    monkeypatch.setattr(sb3_eqr.envs.atari, "MAX_STEPS", GAME_STEPS)
    monkeypatch.chdir(tmp_path)
    a_benchmark(tmp_path / "results" / "smoke", {"eqr_qrdqn": {"CartPole-v1": [475.0]}}, load_suite("smoke"))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block(page, shortened):
    for example in examples_of(page):
        example.evaluate()
    missed = r"^\n {4,}\w.*$|^[\s>*+-]*(?:```|~~~|:::)"  # without a fence, or with another kind of fence
    assert not re.findall(missed, without_blocks(page.read_text(encoding="utf-8")), re.M)


def test_commands_within_sentences_and_tables():
    """Complete commands such as `sb3-eqr train ...` within a line of text, without placeholders."""
    text = "\n".join(without_blocks(page.read_text(encoding="utf-8")) for page in PAGES)
    spans = re.findall(r"`((?:[A-Z_]+=\S+ )?(?:sb3-eqr [a-z]\w* -|python examples/|python -m |make |pip )[^`]*)`", text)
    whole = [span for span in spans if not re.search(r"\.\.\.|\[FOLDER|\bCOMMAND\b|sb3_eqr\.zoo$", span)]
    assert len(whole) > 10
    for span in whole:
        for words in command_lines(span):
            check_command(words)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_exist(page):
    """Relative links, as on GitHub and in Sphinx: to a file, and to a heading in it."""
    text = without_blocks(page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", text):
        path, _, anchor = target.partition("#")
        found = page.parent / path if path else page
        assert found.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", found.read_text(encoding="utf-8"), re.M)
            assert anchor in [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings], target


@pytest.mark.parametrize("notebook", sorted((DOCS / "tutorials").glob("*.ipynb")), ids=name_of)
def test_notebooks_run_and_have_outputs(notebook, shortened):
    """Every code cell runs, shortened; the saved outputs, which the pages show, are of a complete run without an error."""
    pytest.importorskip("IPython")
    cells = [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    matplotlib.use("Agg")
    namespace = {}
    for cell in cells:
        exec("".join(cell["source"]), namespace)
        assert cell["execution_count"] and all(output["output_type"] != "error" for output in cell["outputs"])
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell["outputs"])


STORY = [  # lines of the pages in a working order, and arguments that shorten them by overriding earlier ones
    ("sb3-eqr train --algo eqr_qrdqn --env CartPole-v1 --eval-freq 5000", "-n 400 --eval-freq 200 --eval-episodes 2"),
    ("sb3-eqr enjoy --algo eqr_qrdqn --env CartPole-v1 -f logs --no-render", "-n 50"),
    (
        "sb3-eqr benchmark run results/smoke --suite smoke --agents eqr_qrdqn:off eqr_qrdqn qrdqn:stock --seeds 2",
        "--steps 300 --seeds 1",
    ),
    ("sb3-eqr benchmark status results/smoke", ""),
    ("sb3-eqr benchmark report results/smoke", ""),
    ("python examples/demo.py --game Boxing --config se2+aet --steps 100000", "--steps 30 --eval-episodes 1"),
    (
        "python examples/blind_cliffwalk.py --seeds 10 --json docs/results/cliffwalk.json",
        "--seeds 1 --states 2 --json cliffwalk.json",
    ),
]


@pytest.mark.slow
def test_commands_run(tmp_path):
    text = "\n".join(example.parsed for page in PAGES for example in examples_of(page) if example.region.evaluator is check_sh)
    written = list(command_lines(text))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    for line, changes in STORY:
        assert line.split() in written, f"no page has: {line}"
        program, *arguments = [*line.split(), *changes.split()]
        if program == "python":
            command = [sys.executable, str(ROOT / arguments[0]), *arguments[1:]]
        else:
            command = [str(pathlib.Path(sys.executable).parent / program), *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{line} {changes}\n{done.stdout}\n{done.stderr}"
    results = ("logs/eqr_qrdqn", "results/smoke/report/report.html", "demo_results/Boxing-se2+aet/training.png")
    for path in (*results, "cliffwalk.json"):
        assert (tmp_path / path).exists(), path


@pytest.mark.slow
def test_the_pages_build_without_warnings(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", str(DOCS), str(tmp_path / "html")]
    done = subprocess.run([*command, "-d", str(tmp_path / "doctrees")], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
