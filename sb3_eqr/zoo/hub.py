"""Additions to RL Zoo for the Hugging Face Hub: a dry run, and a model card with our commands."""

import importlib
import os
import pathlib
import shutil
from typing import Any, NoReturn

import huggingface_hub
import huggingface_sb3
import requests
import wasabi

from sb3_eqr.common.saving.files import temporary_folder

DOWNLOAD = huggingface_sb3.load_from_hub
REPLACED = {
    "pip install rl_zoo3": 'pip install ".[atari,zoo]"  # in a clone of the repository of sb3-eqr',
    "python -m rl_zoo3.": "sb3-eqr ",
    "\nsb3-eqr load_from_hub": "\nTRUST_REMOTE_CODE=True sb3-eqr load_from_hub",  # it unpickles the model
}


def correct_card(folder: str | pathlib.Path) -> None:
    """In the model card that RL Zoo has written into a folder, use commands that know our agents."""
    card = pathlib.Path(folder) / "README.md"
    text = card.read_text(encoding="utf-8")
    for old, new in REPLACED.items():
        text = text.replace(old, new)
    second = text.find("If you installed the RL Zoo3 via pip")  # repeats the commands
    end = text.find("## Training", second)
    card.write_text(text if second < 0 else text[:second] + text[end:], encoding="utf-8")


class CheckedHub(huggingface_hub.HfApi):
    """Corrects the model card before the upload."""

    def upload_folder(self, *, folder_path: str | pathlib.Path, **kwargs: Any) -> Any:  # type: ignore[override]
        """Correct the card, then upload as ``HfApi`` does."""
        correct_card(folder_path)
        return super().upload_folder(folder_path=folder_path, **kwargs)


class DryHub(huggingface_hub.HfApi):
    """Builds everything in the folder and uploads nothing."""

    def create_repo(self, repo_id: str, **kwargs: Any) -> str:  # type: ignore[override]
        """:return: a placeholder for the address"""
        return f"{repo_id} (not uploaded)"

    def snapshot_download(self, repo_id: str, *, local_dir: str | pathlib.Path, **kwargs: Any) -> str:  # type: ignore[override]
        """:return: the folder, which is created"""
        pathlib.Path(local_dir).mkdir(parents=True, exist_ok=True)
        return str(local_dir)

    def upload_folder(self, *, folder_path: str | pathlib.Path, **kwargs: Any) -> NoReturn:  # type: ignore[override]
        """Correct the card, and exit before RL Zoo reports a successful upload."""
        correct_card(folder_path)
        print(f"--dry-run: built in {folder_path}, nothing was uploaded.")
        raise SystemExit(0)


def generate_metadata(*args: Any) -> dict[str, Any]:
    """
    The metadata of a model card: huggingface_sb3's, under the name and in the form that RL Zoo expects. Can be removed once
    https://github.com/huggingface/huggingface_sb3/issues/54 is fixed.
    """
    found = importlib.import_module("huggingface_sb3.push_to_hub")._generate_metadata(*args).to_dict()
    return found | {"tags": [*found["tags"], "sb3-eqr"]}


def load_from_hub(repo_id: str, filename: str) -> str:
    """
    As huggingface_sb3's, but raises ``requests.HTTPError`` if there is no such file. RL Zoo 2.9 expects it for models without
    normalisation; current versions of huggingface_hub raise another (https://github.com/DLR-RM/rl-baselines3-zoo/issues/252).
    """
    try:
        return DOWNLOAD(repo_id, filename)
    except huggingface_hub.errors.EntryNotFoundError as error:
        raise requests.HTTPError(str(error)) from error


def prepare(dry_run: bool) -> None:
    """Patch what RL Zoo's ``push_to_hub``, which only builds the folder if ``dry_run``, and ``load_from_hub`` use."""
    huggingface_hub.HfApi = DryHub if dry_run else CheckedHub  # type: ignore[misc]
    if dry_run:
        wasabi.Printer.info = lambda *_: None  # type: ignore[method-assign] # RL Zoo says that it pushes
    importlib.import_module("huggingface_sb3.push_to_hub").generate_metadata = generate_metadata  # type: ignore[attr-defined]
    huggingface_sb3.load_from_hub = load_from_hub
    provide_ffmpeg()


def provide_ffmpeg() -> None:
    """If there is no ``ffmpeg`` command, which the video needs, add moviepy's to the path."""
    if shutil.which("ffmpeg") is None:
        import imageio_ffmpeg

        folder = temporary_folder()
        os.symlink(imageio_ffmpeg.get_ffmpeg_exe(), folder / "ffmpeg")
        os.environ["PATH"] += f"{os.pathsep}{folder}"
