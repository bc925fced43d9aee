"""What the Hugging Face Hub needs beside RL Zoo: a look before the upload, and a model card that names our commands."""

import importlib
import os
import pathlib
import shutil
import tempfile
from typing import Any, NoReturn

import huggingface_hub
import huggingface_sb3
import requests

DOWNLOAD = huggingface_sb3.load_from_hub
REPLACED = {
    "pip install rl_zoo3": 'pip install ".[atari,zoo]"  # in a clone of the repository of sb3-eqr',
    "python -m rl_zoo3.": "sb3-eqr ",
}


def correct_card(text: str) -> str:
    """
    :param text: a model card of RL Zoo's
    :return: the same with commands that know our agents
    """
    for old, new in REPLACED.items():
        text = text.replace(old, new)
    text = text.replace("\nsb3-eqr load_from_hub", "\nTRUST_REMOTE_CODE=True sb3-eqr load_from_hub")  # it unpickles
    second = text.find("If you installed the RL Zoo3 via pip")  # the same commands once more
    end = text.find("## Training", second)
    return text if second < 0 else text[:second] + text[end:]


class CheckedHub(huggingface_hub.HfApi):
    """Corrects the model card before the upload."""

    def upload_folder(self, *, folder_path: str | pathlib.Path, **kwargs: Any) -> Any:  # type: ignore[override]
        """As that of ``HfApi``."""
        card = pathlib.Path(folder_path) / "README.md"
        card.write_text(correct_card(card.read_text(encoding="utf-8")), encoding="utf-8")
        return self._send(folder_path, kwargs)

    def _send(self, folder_path: str | pathlib.Path, kwargs: dict[str, Any]) -> Any:
        return super().upload_folder(folder_path=folder_path, **kwargs)


class DryHub(CheckedHub):
    """Builds everything in the folder and sends nothing."""

    def create_repo(self, repo_id: str, **kwargs: Any) -> str:  # type: ignore[override]
        """
        :return: what stands for the address
        """
        return f"{repo_id} (not uploaded)"

    def snapshot_download(self, repo_id: str, *, local_dir: str | pathlib.Path, **kwargs: Any) -> str:  # type: ignore[override]
        """
        :return: the folder, made
        """
        pathlib.Path(local_dir).mkdir(parents=True, exist_ok=True)
        return str(local_dir)

    def _send(self, folder_path: str | pathlib.Path, kwargs: dict[str, Any]) -> NoReturn:
        print(f"--dry-run: built in {folder_path}, nothing was uploaded.")
        raise SystemExit(0)  # before RL Zoo tells of a success


def generate_metadata(*args: Any) -> dict[str, Any]:
    """
    The head of a model card: huggingface_sb3's, under the name and in the form that RL Zoo asks for. Not needed any more once
    https://github.com/huggingface/huggingface_sb3/issues/54 is solved.
    """
    found = importlib.import_module("huggingface_sb3.push_to_hub")._generate_metadata(*args).to_dict()
    return found | {"tags": [*found["tags"], "sb3-eqr"]}


def load_from_hub(repo_id: str, filename: str) -> str:
    """
    :param repo_id: of the repository
    :param filename: in it
    :return: where the file is after the download
    :raises requests.HTTPError: if there is no such file: what RL Zoo 2.9 expects where normalisation is not used, and current
        versions of huggingface_hub do not raise (https://github.com/DLR-RM/rl-baselines3-zoo/issues/252)
    """
    try:
        return DOWNLOAD(repo_id, filename)
    except huggingface_hub.errors.EntryNotFoundError as error:
        raise requests.HTTPError(str(error)) from error


def prepare(dry_run: bool) -> None:
    """
    Set the stage for RL Zoo's ``push_to_hub`` and ``load_from_hub``.

    :param dry_run: whether to build the folder only
    """
    huggingface_hub.HfApi = DryHub if dry_run else CheckedHub  # type: ignore[misc]
    importlib.import_module("huggingface_sb3.push_to_hub").generate_metadata = generate_metadata  # type: ignore[attr-defined]
    huggingface_sb3.load_from_hub = load_from_hub
    provide_ffmpeg()


def provide_ffmpeg() -> None:
    """Where there is no ``ffmpeg`` command, which the video needs, put that of moviepy in the path."""
    if shutil.which("ffmpeg") is None:
        import imageio_ffmpeg

        folder = tempfile.mkdtemp(prefix="sb3-eqr-")
        os.symlink(imageio_ffmpeg.get_ffmpeg_exe(), os.path.join(folder, "ffmpeg"))
        os.environ["PATH"] += os.pathsep + folder
