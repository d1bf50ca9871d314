# SPDX-License-Identifier: Apache-2.0
"""Kernels compile in the background; a step on the CPU waits for those that it needs, and for no others."""

import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import warp as wp
from warp_lcp.kernels import watch

import warp_lcp as wl
from warp_lcp import loading
from warp_lcp.loading import Loading, Queue


def use_queue_of_its_own(monkeypatch):
    """One whose threads nobody else needs."""
    queue = Queue()
    monkeypatch.setattr(loading, "_queue", lambda: queue)
    return queue


class Gate:
    """Holds up the loading of some kernels, and tells what began to load."""

    def __init__(self, monkeypatch, *held):
        self.held, self.begun, self.opened = held, [], threading.Event()
        load = wp.force_load

        def wait(device, modules, block_dim=None):
            (module,) = modules
            self.begun.append(module.name.split(".")[3])
            if self.begun[-1] in self.held:
                assert self.opened.wait(60.0)
            load(device, modules=modules, block_dim=block_dim)

        monkeypatch.setattr(wp, "force_load", wait)
        monkeypatch.setattr("os.cpu_count", lambda: len(held) + 2)  # threads that are left when all of these wait
        use_queue_of_its_own(monkeypatch)


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


def test_first_steps_wait_for_no_kernel_that_they_do_not_need(monkeypatch):
    """Balls too far apart to meet, and a contact that velocity pivoting solves: the same bits as with every kernel there."""
    model = balls(0.11, 1.0)
    expected = moved(model, 100)
    gate = Gate(monkeypatch, "sphere_sphere", "proximal_contacts", "pgs", "reset")
    sim = wl.Simulator(model, 2, device="cpu")
    sim.step(100)
    for mine, theirs in zip(state(sim), expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert sim.contacts.count.numpy().tolist() == [1, 1]
    assert not gate.opened.is_set()
    gate.opened.set()
    sim.step(0)
    assert {"sphere_sphere", "proximal_contacts", "pgs", "reset"} <= set(gate.begun)


def links():
    """Two bars on a ball joint that fall flat."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    along_x = (0, 0.5**0.5, 0, 0.5**0.5)
    for x in (0.0, 0.4):
        builder.add_capsule(builder.add_body(pose=(x, 0, 0.2, *along_x), velocity=(0, 0, -2)), 0.05, 0.15)
    ahead, behind = ((0, 0, z, 0, 0, 0, 1) for z in (0.2, -0.2))
    builder.add_joint(wl.JointType.SPHERICAL, 0, 1, parent_frame=ahead, child_frame=behind)
    return builder.finalize()


@pytest.mark.parametrize(
    ("model", "held"), [(balls, "sphere_sphere"), (balls, "pivot"), (balls, "certify"), (balls, "contact_rows"), (links, "land")]
)
def test_a_step_waits_for_a_kernel_that_it_needs(monkeypatch, model, held):
    """Among others for that of pairs once they come near; the answer is the one of a start without waiting."""
    model = model(0.11, 0.35) if model is balls else model()
    expected = moved(model, 200)
    gate = Gate(monkeypatch, held)
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


def test_a_step_waits_for_the_next_method_where_the_first_one_fails(monkeypatch):
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
    gate = Gate(monkeypatch, "proximal_contacts")
    sim = spoilt()
    stepping = threading.Thread(target=sim.step, daemon=True)
    stepping.start()
    stepping.join(0.5)
    assert stepping.is_alive()
    gate.opened.set()
    stepping.join(60.0)
    for mine, theirs in zip(state(sim), state(plain), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_what_somebody_waits_for_is_loaded_next(monkeypatch):
    begun, opened = [], threading.Event()
    monkeypatch.setattr(wp, "force_load", lambda device, modules, block_dim: (begun.append(modules[0].name), opened.wait(60.0)))
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    queue, cpu = use_queue_of_its_own(monkeypatch), wp.get_device("cpu")

    class Kernel:
        def __init__(self, name):
            self.module = type("Module", (), {"name": name, "options": {"block_dim": 1}})()

    kernels = {name: Kernel(name) for name in "abcd"}
    ours = Loading(cpu)
    for kernel in kernels.values():
        ours.begin(kernel)
    while not begun:
        time.sleep(0.001)
    waiting = threading.Thread(target=ours.finish, args=([kernels["d"]],))
    waiting.start()
    while queue._turn[0][0].name != "d":
        time.sleep(0.001)
    opened.set()
    waiting.join()
    assert kernels["d"] not in ours
    assert kernels["b"] in ours
    ours.finish()
    assert begun == ["a", "d", "b", "c"]
    assert not ours


def test_a_module_is_loaded_once_for_all_who_wait_and_what_went_wrong_is_told(monkeypatch):
    tries = []

    def fail(device, modules, block_dim):
        tries.append(modules)
        time.sleep(0.1)
        raise RuntimeError("the compiler is missing")

    monkeypatch.setattr(wp, "force_load", fail)
    use_queue_of_its_own(monkeypatch)
    kernel = watch.make()
    mine, yours = Loading(wp.get_device("cpu")), Loading(wp.get_device("cpu"))
    for each in (mine, yours):
        each.begin(kernel)
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
