# SPDX-License-Identifier: Apache-2.0
"""Kernels compile in the background; a step on the CPU waits for those that it needs, and for no others."""

import math
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import warp as wp
from warp_lcp.kernels import declare, watch

import warp_lcp as wl
from warp_lcp import loading
from warp_lcp.loading import Loading, Queue


@pytest.fixture
def own_queue(monkeypatch):
    """A queue whose threads nobody else needs, and nobody else's at work; with as many as a test wants."""
    loading._queue().settle()
    made = []

    def use(threads):
        monkeypatch.setattr("os.cpu_count", lambda: threads)
        made.append(Queue())
        monkeypatch.setattr(loading, "_queue", lambda: made[-1])
        return made[-1]

    yield use
    for queue in made:
        queue.settle()


def soon(condition):
    """Wait until it is so."""
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


class Gate:
    """Holds up the loading of some kernels, and tells what began to load."""

    def __init__(self, monkeypatch, own_queue, *held):
        self.held, self.begun, self.opened = held, [], threading.Event()
        load = wp.force_load

        def wait(device, modules, block_dim=None):
            (module,) = modules
            self.begun.append(module.name.split(".")[4])
            if self.begun[-1] in self.held:
                assert self.opened.wait(60.0)
            load(device, modules=modules, block_dim=block_dim)

        monkeypatch.setattr(wp, "force_load", wait)
        own_queue(len(held) + 2)  # threads that are left when all of these wait


def balls(*heights):
    """Balls of 0.1 m above each other and above the ground."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    for z in heights:
        builder.add_sphere(builder.add_body(pose=(0, 0, z, 0, 0, 0, 1)), 0.1)
    return builder.finalize()


def moved(model, steps, **options):
    """State after steps that nothing held up."""
    sim = wl.Simulator(model, 2, device="cpu", **options)
    sim.step(0)
    sim.step(steps)
    return sim.q.numpy(), sim.v.numpy(), sim.residual.numpy(), sim.iterations.numpy()


def state(sim):
    return sim.q.numpy(), sim.v.numpy(), sim.residual.numpy(), sim.iterations.numpy()


def links(bend, speed):
    """Two bars on a ball joint that fall, flat or with one end ahead [rad]."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    for angle, x, z in ((0.0, 0.0, 0.2), (bend, 0.2 + 0.2 * math.cos(bend), 0.2 - 0.2 * math.sin(bend))):
        turn = 0.5 * (0.5 * math.pi + angle)
        pose = (x, 0, z, 0, math.sin(turn), 0, math.cos(turn))
        builder.add_capsule(builder.add_body(pose=pose, velocity=(0, 0, -speed)), 0.05, 0.15)
    ahead, behind = ((0, 0, z, 0, 0, 0, 1) for z in (0.2, -0.2))
    builder.add_joint(wl.JointType.SPHERICAL, 0, 1, parent_frame=ahead, child_frame=behind)
    return builder.finalize()


@pytest.mark.parametrize(
    ("model", "held"),
    [
        (balls(0.11, 1.0), ("sphere_sphere", "pgs")),
        (links(0.0, 8.0), ("judge_landing", "land")),
        (links(0.3, 2.0), ("land",)),
    ],
    ids=["far apart", "not turned", "turned by too little"],
)
def test_first_steps_wait_for_no_kernel_that_they_do_not_need(monkeypatch, own_queue, model, held):
    """Balls too far apart to meet, and a contact that velocity pivoting solves; links that a hit does not turn, or turns by too little to
    land: the same bits as with every kernel there."""
    expected = moved(model, 100)
    held += ("proximal_contacts", "reset")
    gate = Gate(monkeypatch, own_queue, *held)
    sim = wl.Simulator(model, 2, device="cpu")
    sim.step(100)
    for mine, theirs in zip(state(sim), expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert (sim.contacts.count.numpy() > 0).all()
    assert not gate.opened.is_set()
    gate.opened.set()
    sim.step(0)
    assert set(held) <= set(gate.begun)


@pytest.mark.parametrize("held", ["sphere_sphere", "pivot", "certify", "contact_rows", "judge_landing", "land"])
def test_a_step_waits_for_a_kernel_that_it_needs(monkeypatch, own_queue, held):
    """Among others for that of pairs once they come near; the answer is the one of a start without waiting."""
    model = links(0.3, 8.0) if "land" in held else balls(0.11, 0.35)
    expected = moved(model, 200)
    gate = Gate(monkeypatch, own_queue, held)
    sim = wl.Simulator(model, 2, device="cpu")
    stepping = threading.Thread(target=sim.step, args=(200,), daemon=True)
    stepping.start()
    stepping.join(0.5)
    assert stepping.is_alive()
    gate.opened.set()
    stepping.join(60.0)
    assert not stepping.is_alive()
    for mine, theirs in zip(state(sim), expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_step_waits_for_the_next_method_where_the_first_one_fails(monkeypatch, own_queue):
    """Contacts so stiff that velocity pivoting cannot certify its answer."""
    model = balls(0.0999)

    def spoilt():
        sim = wl.Simulator(model, 2, device="cpu")
        contact = model.contact.copy()
        contact[:, :2] = 1e18
        sim.set_parameters(contact=contact)
        sim.v.assign(np.tile([1e4, 0, -1e4, 0, 0, 0], (2, 1)))
        return sim

    plain = spoilt()
    plain.step(0)
    plain.step(1)
    assert plain.queued.numpy()[0] > 0
    gate = Gate(monkeypatch, own_queue, "proximal_contacts")
    sim = spoilt()
    stepping = threading.Thread(target=sim.step, daemon=True)
    stepping.start()
    stepping.join(0.5)
    assert stepping.is_alive()
    gate.opened.set()
    stepping.join(60.0)
    for mine, theirs in zip(state(sim), state(plain), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_what_somebody_waits_for_is_loaded_next(monkeypatch, own_queue):
    begun, opened = [], threading.Event()
    monkeypatch.setattr(wp, "force_load", lambda device, modules, block_dim: (begun.append(modules[0].name), opened.wait(60.0)))
    queue, cpu = own_queue(1), wp.get_device("cpu")

    class Kernel:
        def __init__(self, name):
            self.module = type("Module", (), {"name": name, "options": {"block_dim": 1}})()

    kernels = {name: Kernel(name) for name in "abcd"}
    ours = Loading(cpu)
    for kernel in kernels.values():
        ours.begin(kernel)
    soon(lambda: begun)
    waiting = threading.Thread(target=ours.finish, args=([kernels["d"]],))
    waiting.start()
    soon(lambda: queue._turn[0][0].name == "d")
    opened.set()
    waiting.join()
    assert kernels["d"] not in ours
    assert kernels["b"] in ours
    ours.finish()
    assert begun == ["a", "d", "b", "c"]
    assert not ours


def test_a_module_is_loaded_once_for_all_who_wait_and_what_went_wrong_is_told(monkeypatch, own_queue):
    tries, asked = [], threading.Event()

    def fail(device, modules, block_dim):
        tries.append(modules)
        assert asked.wait(60.0)
        raise RuntimeError("the compiler is missing")

    monkeypatch.setattr(wp, "force_load", fail)
    own_queue(2)
    kernel = watch.make()
    mine, yours = Loading(wp.get_device("cpu")), Loading(wp.get_device("cpu"))
    for each in (mine, yours):
        each.begin(kernel)
    asked.set()
    for each in (mine, yours):
        with pytest.raises(RuntimeError, match="the compiler is missing"):
            each.finish([kernel])
        assert not each
    assert len(tries) == 1
    mine.begin(kernel)
    with pytest.raises(RuntimeError, match="the compiler is missing"):
        mine.finish()
    assert len(tries) == 2


def test_a_forked_process_loads_kernels_of_its_own():
    """Threads do not survive a fork, and one that loads would leave locks behind: some are still loading after the first step."""
    code = """
import os, warp_lcp as wl
wl.Simulator(wl.load_usd("box_on_ground"), device="cpu").step()
child = os.fork()
if child == 0:
    wl.Simulator(wl.load_usd("box_on_ground"), device="cpu", method="pgs").step()
    os._exit(0)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=200)


def test_a_step_in_a_capture_of_the_user_is_refused(monkeypatch, own_queue):
    """It could be recorded without what it did not need at that time."""
    gate = Gate(monkeypatch, own_queue, "pgs")
    sim = wl.Simulator(balls(0.11), device="cpu")
    threading.Timer(0.5, gate.opened.set).start()
    with pytest.raises(RuntimeError, match="capture"), wp.ScopedCapture(device="cpu"):
        sim.step()


def test_loaded_kernels_do_not_wait_behind_others(monkeypatch, own_queue):
    moved(balls(0.11), 2)
    gate = Gate(monkeypatch, own_queue, "pgs", "bounds")
    first = loading._queue()
    for kernel in wl.Simulator(balls(0.11), device="cpu").kernels:
        if "pgs" not in kernel.module.name:
            first.add(kernel, wp.get_device("cpu")).result(60.0)
    begun = len(gate.begun)
    wl.Simulator(balls(0.11), device="cpu").step()
    assert len(gate.begun) == begun
    gate.opened.set()


def test_a_factory_that_was_interrupted_can_be_asked_again():
    calls = []

    @declare.factory
    def make(real, twice=False):
        @declare.kernel()
        def first(x: wp.array(dtype=real)):
            x[0] = real(1.0)

        calls.append(real)
        if len(calls) == 1:
            raise KeyboardInterrupt

        if twice:

            @declare.kernel()
            def first(x: wp.array(dtype=real)):
                x[0] = real(2.0)

        return first

    with pytest.raises(KeyboardInterrupt):
        make(wp.float64)
    assert make(wp.float64) is make(wp.float64, False) is make(real=wp.float64)
    assert make(wp.float32) is not make(wp.float64)
    with pytest.raises(NameError, match="two kernels"):
        make(wp.float64, True)
