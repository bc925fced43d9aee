"""Values survive a round trip through JSON, and loading executes no code."""

import json
import sys
from collections import deque
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import LinearSchedule

from sb3_eqr.common.groups import MatrixLieGroup, make_group
from sb3_eqr.common.resets import ResetSchedule
from sb3_eqr.common.saving.plain_data import KIND, UntrustedError, decode, encode
from sb3_eqr.eqr_rainbow import CnnPolicy


def again(value, trust=False):
    return decode(json.loads(json.dumps(encode(value))), trust)


VALUES = [
    *(None, True, 3, 2.5, "text", [1, [2.0, "x"]], (1, (2,)), {"a": {"b": (1,)}}, {1: "one", (2, 3): None}, {KIND: "dict"}),
    *(deque([1, 2], maxlen=5), deque(), float("inf"), CnnPolicy, th.nn.ReLU, th.optim.AdamW, np.random.get_state()[0]),
    *(TrainFreq(4, TrainFrequencyUnit("step")), ResetSchedule(interval=10), spaces.Discrete(3, start=0)),
    spaces.Box(np.array([-1.0, 0.0]), np.array([1.0, 2.0]), dtype=np.float64),
    spaces.Dict({"image": spaces.Box(0, 255, (4, 36, 36), np.uint8), "vector": spaces.Box(-np.inf, np.inf, (3,))}),
    spaces.Tuple((spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(4))),
]


@pytest.mark.parametrize("value", VALUES, ids=str)
def test_round_trip_of_values(value):
    found = again(value)
    assert type(found) is type(value) and found == value
    assert "pickle" not in json.dumps(encode(value))


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_round_trip_of_discrete_spaces_keeps_dtype_and_start(dtype):
    for space in (spaces.Discrete(3, start=2, dtype=dtype), spaces.MultiDiscrete([2, 3], dtype, start=[1, 0])):
        found = again(space)
        assert found == space and found.dtype == dtype and np.array_equal(found.start, space.start)


def test_round_trip_of_dict_spaces_keeps_the_order_of_keys():
    space = spaces.Dict(velocity=spaces.Discrete(2), angle=spaces.Dict(z=spaces.Discrete(2), a=spaces.Discrete(3)))
    found = again(space)
    assert list(found) == ["velocity", "angle"] and list(found["angle"]) == ["z", "a"]


@pytest.mark.parametrize("array", [np.arange(6.0).reshape(2, 3), np.zeros((0, 2), np.uint8), np.float32(2.5), np.bool_(True)])
def test_round_trip_of_arrays_keeps_shape_and_dtype(array):
    found = again(array)
    assert type(found) is type(array) and found.dtype == array.dtype and np.array_equal(found, array)


def test_round_trip_of_tensors_schedules_generators_and_groups():
    tensor = th.get_rng_state()
    assert th.equal(again(tensor), tensor) and again(tensor).dtype == tensor.dtype
    schedule = again(LinearSchedule(1.0, 0.0, 0.5))
    assert [schedule(1 - t) for t in (0.0, 0.25, 0.5)] == [1.0, 0.5, 0.0]
    assert again(np.random.default_rng(0).bit_generator.state) == np.random.default_rng(0).bit_generator.state
    generators = [[[0.0, 1, 0], [-1, 0, 0], [0, 0, 0]], [[0, 0, 1], [0, 0, 0], [0, 0, 0]]]
    params = th.randn(2, 2)
    for group in (MatrixLieGroup(generators), make_group("SE(2)^2 x SO(3)"), make_group("SO(2)", "gram-schmidt")):
        params = th.randn(2, group.num_params)
        assert th.equal(again(group).element(params), group.element(params))


class Own(th.nn.Module):
    pass


def test_objects_that_need_a_pickle_need_trust():
    for value in (Own, lambda x: x, partial(print, 1)):
        with pytest.raises(UntrustedError):
            again({"deep": [value]})
        again({"deep": [value]}, trust=True)
    assert again(Own, trust=True) is Own


FORGED = [
    {KIND: "pickle", "pickle": ""},
    {KIND: "class", "module": "subprocess", "name": "Popen"},
    {KIND: "class", "module": "torch.serialization", "name": "os.system"},
    {KIND: "class", "module": "torch", "name": "load"},
    {KIND: "object", "module": "os", "name": "environ", "attributes": {}},
    {KIND: "object", "module": "sb3_eqr.common.resets", "name": "check_names", "attributes": {}},
    {KIND: "class", "module": "sb3_eqr.common.saving.plain_data", "name": "decode"},
    {KIND: "space", "name": "Graph", "arguments": {}},
    {KIND: "something"},
]


@pytest.mark.parametrize("forged", FORGED, ids=str)
def test_forged_data_raises(forged):
    with pytest.raises(ValueError):
        decode(forged)


def test_a_file_cannot_choose_the_imported_module():
    program = "torch.utils.model_dump.__main__"
    with pytest.raises(ValueError, match=r"must name a class that agents use, got torch\.utils\.model_dump"):
        decode({KIND: "class", "module": program, "name": "Module"})
    assert program not in sys.modules
    optimizer = {"module": "stable_baselines3.common.sb2_compat.rmsprop_tf_like", "name": "RMSpropTFLike"}
    assert issubclass(decode({KIND: "class", **optimizer}), th.optim.Optimizer)


def test_declared_sizes_take_no_memory():
    for shape in ([1 << 40], [1 << 20, 1 << 20], [-1, 1 << 40]):
        with pytest.raises(ValueError):
            decode({KIND: "array", "dtype": "<f8", "shape": shape, "data": "AAAA"})
    with pytest.raises(ValueError):
        decode({KIND: "array", "dtype": "O", "shape": [1], "data": "AAAAAAAAAAA="})
