import pytest
import torch as th

from tests.models import MAKERS
from tests.toys import ChainEnv

th.set_num_threads(1)  # small networks are slower on two threads, and xdist runs two tests at once


@pytest.fixture(autouse=True)
def no_gpu(request, monkeypatch):
    """Hide a GPU from the tests that do not ask for it: they compare bit by bit with what a CPU computes."""
    if request.node.get_closest_marker("gpu") is None:
        monkeypatch.setattr(th.cuda, "is_available", lambda: False)
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # for the processes that a test starts


@pytest.fixture(params=MAKERS, ids=lambda maker: maker.algorithm.__name__)
def make(request):
    """A maker of small agents, of each algorithm in turn."""
    return request.param


@pytest.fixture
def model(make):
    """A small agent after twelve updates."""
    return make(ChainEnv()).learn(46)
