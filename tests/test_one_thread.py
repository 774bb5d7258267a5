"""Threads, forks, copies and a Taichi that others start: a sentence where Taichi would crash or hang (C9)."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
import threading

import numpy as np
import pytest
from map_kinds import KINDS, answers, content, frames, integrated

from taichi_unifusion import Pipeline
from taichi_unifusion.errors import InputError, RuntimeStateError
from taichi_unifusion.maps import FeatureMap

PATIENCE = 60  # [s] for a child that hangs


@pytest.fixture(scope="module", params=KINDS)
def filled(request):
    return integrated(KINDS[request.param](), frames()[:2])


def test_c9_another_thread_is_refused_and_changes_nothing(filled):
    before, errors = content(filled), []

    def use():
        for work in (
            lambda: filled.integrate(frames()[2]),
            lambda: answers(filled),
            filled.voxels,
            lambda: filled.memory_bytes,
            Pipeline,
        ):
            try:
                work()
            except RuntimeStateError as error:
                errors.append(str(error))

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert len(errors) == 5 and all("thread that started Taichi" in text for text in errors)
    assert content(filled) == before


def test_c9_a_forked_child_ends_with_a_sentence(filled):
    read, write = os.pipe()
    child = os.fork()
    if not child:  # only what cannot block may run here
        try:
            filled.integrate(frames()[0])
        except RuntimeStateError as error:
            os.write(write, str(error).encode())
        finally:
            os._exit(0)
    os.close(write)
    killer = threading.Timer(PATIENCE, os.kill, (child, 9))
    killer.start()
    with os.fdopen(read) as said:
        assert "'spawn'" in said.read()
    assert os.waitpid(child, 0)[1] == 0
    killer.cancel()


def test_c9_a_foreign_start_of_taichi_is_noticed():
    code = """
import numpy as np, taichi as ti, taichi_unifusion as uf
uf.init("cpu")
m = uf.PropertyMap("c", 1)
ti.init(ti.cpu, log_level=ti.ERROR)
points = np.zeros((1, 3), np.float32)
for work in (
    lambda: m.query(points),
    lambda: m.save("never.safetensors"),
    lambda: m.integrate(uf.PointCloud(points, None, {"c": points[:, :1]})),
    lambda: uf.SurfaceMap(),
):
    try:
        work()
    except uf.UniFusionError as error:
        print(type(error).__name__, "(ti.init)" in str(error))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split()[-8:] == ["RuntimeStateError", "True"] * 4, done.stderr


def test_c9_copies_are_equal_and_independent(filled):
    before = content(filled)
    for twin in (copy.copy(filled), copy.deepcopy(filled)):
        assert content(twin) == before and answers(twin) == answers(filled)
        twin.integrate(frames()[2])
        assert content(twin) != before and content(filled) == before


def test_c9_a_map_is_not_pickled(filled):
    for each in (filled, FeatureMap("clip", 8)):
        with pytest.raises(InputError, match="map.save"):
            pickle.dumps(each)
    assert pickle.loads(pickle.dumps(filled.settings)) == filled.settings
    assert np.array_equal(copy.deepcopy(frames()[0]).points, frames()[0].points)
