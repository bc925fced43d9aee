import pytest
import torch as th

from sb3_eqr.common.update_monitor import UpdateMonitor
from tests.models import MAKERS

th.set_num_threads(1)  # small networks are slower on two threads, and xdist runs two tests at once


@pytest.fixture(params=MAKERS, ids=lambda maker: maker.algorithm.__name__)
def make(request):
    """What makes small agents, of each algorithm in turn."""
    return request.param


@pytest.fixture
def backup_each_round(monkeypatch):
    """The way back ends where a round began."""
    monkeypatch.setattr(UpdateMonitor, "INTERVAL", 0)
