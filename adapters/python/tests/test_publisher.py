"""Tests of the Python package through the bytes of the ring."""

import fcntl
import os
import shutil
import struct
import tempfile
import threading
import time
import warnings

import numpy as np
import pytest

from ridgewatch_adapter import Publisher, RidgewatchError


@pytest.fixture
def ring(monkeypatch):
    folder = tempfile.mkdtemp(prefix="rw-python-", dir="/dev/shm")
    os.rmdir(folder)
    monkeypatch.setenv("RIDGEWATCH_RING", folder)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def newest(folder, shape):
    """Number, time and components of the newest step; docs/live.md has the layout."""
    data = open(os.path.join(folder, "block-00000.ring"), "rb").read()
    assert data[:8] == b"RIDGERNG"
    slots, components, stride, first = struct.unpack_from("<IIQQ", data, 24)
    (published,) = struct.unpack_from("<Q", data, 1024)
    slot = first + (published - 1) % slots * stride
    sequence, step, time = struct.unpack_from("<QQd", data, slot)
    assert sequence == 2 * published
    values = np.frombuffer(data, np.float32, components * int(np.prod(shape)), slot + 64)
    return step, time, values.reshape(components, *shape)


def test_arrays_arrive(ring):
    x, y, z = np.linspace(0, 1, 4), np.array([0.0, 1.0, 4.0]), [0, 1]
    field = np.random.default_rng(0).random((3, 2, 3, 4)).astype(np.float32)
    with Publisher(x, y, z, periods=[4 / 3, None, None]) as publisher:
        assert publisher.is_open
        assert publisher.publish(7, 0.5, *field)
        step, time, values = newest(ring, (2, 3, 4))
        assert (step, time) == (7, 0.5) and np.array_equal(values, field)
        # Doubles, interleaved, reversed.
        double = np.ascontiguousarray(np.moveaxis(field.astype(np.float64), 0, -1))[::-1, :, :, :]
        assert publisher.publish(8, 1.0, *(double[..., c] for c in range(3)))
        assert np.array_equal(newest(ring, (2, 3, 4))[2], field[:, ::-1])
        assert publisher.published == 2
    assert not publisher.is_open and not os.path.exists(ring)


@pytest.mark.parametrize("kind", [">f4", ">f8"])
def test_big_endian_arrays_arrive(ring, kind):
    """Arrays of scipy.io.netcdf_file and of FITS files are big-endian."""
    x, y = np.array([0.0, 1.5, 2.0], kind), np.array([-2.0, 1.0], kind)
    field = np.array([[[1.5, -2.25, 3.0], [0.0, 1e-3, 7e9]], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]], kind)
    with Publisher(x, y) as publisher:
        assert publisher.publish(1, 0.5, *field)
        assert np.array_equal(newest(ring, (2, 3))[2], field.astype(np.float32))
        # Interleaved and reversed; and beside a component in the order of this machine.
        for u, v in [np.moveaxis(field, 0, -1)[:, ::-1].transpose(2, 0, 1), (field[0], field[1].astype(kind[1:])[::-1])]:
            assert publisher.publish(2, 1.0, u, v)
            assert np.array_equal(newest(ring, (2, 3))[2], np.array([u, v], np.float32))
        data = open(os.path.join(ring, "block-00000.ring"), "rb").read()
        assert struct.pack("<3d", *x) in data[8192:] and struct.pack("<2d", *y) in data[8192:]
    # An object without a dtype cannot be converted.
    memory = memoryview(field[0])
    with Publisher(x, y) as publisher, pytest.raises(TypeError, match="accepted"):
        publisher.publish(0, 0.0, memory, memory)


def test_masked_values_are_missing(ring):
    x = np.arange(3.0)
    under = np.full((3, 3), 1e20, np.float32)
    mask = np.eye(3, dtype=bool)
    u, v = np.ma.array(under, mask=mask), np.ma.array(2 * under, mask=False)
    with Publisher(x, x) as publisher:
        # One component with a copy, one without.
        for u, v in [(u, v), (u.T, v), (u.astype(">f8"), v.astype(np.float64).T)]:
            assert publisher.publish(0, 0.0, u, v)
            values = newest(ring, (3, 3))[2]
            assert np.isnan(values[0][mask]).all() and (values[0][~mask] == under[0, 0]).all() and (values[1] == 2 * under).all()
        with pytest.raises(TypeError, match="an array of int32; accepted"):
            publisher.publish(1, 1.0, np.ma.array(np.zeros((3, 3), np.int32), mask=mask), v)
    # A masked coordinate is no coordinate.
    with pytest.raises(RidgewatchError, match="axis.coordinates"):
        Publisher(np.ma.array([0.0, 1.0, 2.0], mask=[False, True, False]), x, strict=True)


def test_a_ring_that_was_removed_is_told(ring):
    x = np.arange(4.0)
    good = np.zeros((4, 4), np.float32)
    with Publisher(x, x) as publisher:
        assert publisher.publish(0, 0.0, good, good)
        shutil.rmtree(ring)
        with pytest.warns(RuntimeWarning, match="a step was not published: the ring was removed"):
            assert publisher.publish(1, 1.0, good, good) is False
        with Publisher(x, x) as second:
            assert second.is_open and second.publish(0, 0.0, good, good)
            publisher.close()
            assert os.path.exists(os.path.join(ring, "block-00000.lock")) and second.publish(1, 1.0, good, good)


def test_a_block_of_a_start(ring):
    x, y = np.arange(6.0), np.arange(4.0)
    part = np.ones((4, 2), np.float32)
    with Publisher(x, y, block=(1, 3, [2, 0], [2, 4]), start=20261122) as publisher:
        assert publisher.publish(3, 1.0, part, 2 * part)
        data = open(os.path.join(ring, "block-00001.ring"), "rb").read()
        assert struct.unpack_from("<I", data, 8) == (2,)
        # The description: geometry, axes, radius, start, block and count, offset, extent.
        told = struct.unpack_from("<IIdQII3Q3Q", data, 8192)
        assert told == (0, 2, 0.0, 20261122, 1, 3, 2, 0, 0, 2, 4, 1)


def test_order_xyz(ring):
    field = np.random.default_rng(1).random((2, 5, 3)).astype(np.float32)
    with Publisher(np.arange(5.0), np.arange(3.0), order="xyz") as publisher:
        publisher.publish(0, 0.0, field[0], field[1])
        assert np.array_equal(newest(ring, (3, 5))[2], field.transpose(0, 2, 1))


def test_longitude_and_latitude(ring):
    longitude, latitude = np.arange(0.0, 360.0, 90.0), np.array([-60.0, 0.0, 70.0])
    field = np.random.default_rng(2).random((2, 3, 4))
    with Publisher(longitude, latitude, periods=[360.0, None], radius=6.371e6, time_unit="h") as publisher:
        assert publisher.publish(4, 2.5, *field)
        data = open(os.path.join(ring, "block-00000.ring"), "rb").read()
        assert struct.unpack_from("<IId", data, 8192) == (1, 2, 6.371e6)
        # After index, count, offset and extent: the time unit, then name, unit, period, nodes and coordinates of the first axis.
        assert data[8192 + 80 : 8192 + 85] == b"\x01\0\0\0h"
        assert struct.unpack_from("<I1sIdQ4d", data, 8192 + 85) == (1, b"x", 0, 360.0, 4, *longitude)
        step, time, values = newest(ring, (3, 4))
        assert (step, time) == (4, 2.5) and np.array_equal(values, field.astype(np.float32))
    with pytest.raises(RidgewatchError, match="radius"):
        Publisher(longitude, latitude, radius=-1.0, strict=True)


def test_other_threads_run_and_publish_meanwhile(ring):
    size, threads, steps = 512, 4, 50
    x = np.arange(float(size))
    failed = []
    with Publisher(x, x, slots=8) as publisher:

        def publish(thread):
            field = np.full((size, size), thread, np.float32)
            try:
                for step in range(steps):
                    assert publisher.publish(step, float(step), field, field)
                    assert publisher.is_open and publisher.published > 0 and publisher.overwrote >= 0
            except BaseException as error:
                failed.append(error)

        workers = [threading.Thread(target=publish, args=(n,)) for n in range(threads)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        assert not failed
        assert publisher.published == threads * steps
        values = newest(ring, (size, size))[2]
        assert values[0, 0, 0] in range(threads) and np.all(values == values[0, 0, 0])


def test_closing_while_another_thread_publishes(ring):
    """A thread that waits for a follower keeps the ring, and `close` does not wait for that thread."""
    x = np.arange(4.0)
    good = np.zeros((4, 4), np.float32)
    publisher = Publisher(x, x, slots=2, wait_ms=6000)
    begun, answers = [], []

    def publish():
        for n in range(4):
            begun.append(n)
            answers.append(publisher.publish(n, float(n), good, good))

    worker = threading.Thread(target=publish)
    worker.start()
    # Two steps fill the ring; the third waits.
    while len(begun) < 3:
        time.sleep(0.01)
    time.sleep(1)
    publisher.close()
    assert worker.is_alive() and not publisher.is_open and os.path.exists(ring)
    worker.join()
    # The fourth found it closed.
    assert answers == [True, True, True, False] and not os.path.exists(ring)
    assert publisher.publish(9, 9.0, good, good) is False


def test_opening_and_closing_let_other_threads_run(ring):
    """Opening waits a second for a name that is taken, and closing for a follower that was stopped while it left."""
    x = np.arange(4.0)

    def turns(call):
        """Wake-ups per second of a thread that sleeps while another thread calls."""
        worker = threading.Thread(target=call)
        begin = time.monotonic()
        worker.start()
        count = 0
        while worker.is_alive():
            time.sleep(0.01)
            count += 1
        took = time.monotonic() - begin
        assert took > 0.9
        return count / took

    # The reference blocks no thread. A blocked thread wakes once or twice.
    enough = turns(lambda: time.sleep(1)) / 5
    publisher = Publisher(x, x)
    with pytest.warns(RuntimeWarning, match="another producer"):
        assert turns(lambda: Publisher(x, x)) > enough
    with open(os.open(os.path.join(ring, "followers.lock"), os.O_RDWR | os.O_CREAT, 0o600), "r+") as lock:
        # struct flock: kind, whence, start, length, process.
        fcntl.fcntl(lock, fcntl.F_OFD_SETLK, struct.pack("hhqqixxxx", fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0))
        assert turns(publisher.close) > enough


def test_refusals(ring):
    x = np.arange(4.0)
    good = np.zeros((4, 4), np.float32)
    with pytest.raises(RidgewatchError, match="ascending"):
        Publisher(x[::-1].copy(), x, strict=True)
    with pytest.raises(ValueError, match="order"):
        Publisher(x, x, order="yx")
    with Publisher(x, x, strict=True) as publisher:
        with pytest.raises(RidgewatchError, match="another producer"):
            Publisher(x, x, strict=True)
        with pytest.raises(ValueError, match="components"):
            publisher.publish(0, 0.0, good, good, good)
        with pytest.raises(ValueError, match="accepted"):
            publisher.publish(0, 0.0, good[:3], good[:3])
        with pytest.raises(ValueError, match=r"v is float64 with strides \[1, 4\]; accepted: that of u, float32 with strides \[1, 4\]"):
            publisher.publish(0, 0.0, good, good.astype(np.float64))
        with pytest.raises(TypeError, match="an array of int32; accepted: NumPy arrays of float32 or float64"):
            publisher.publish(0, 0.0, good.astype(np.int32), good)
        with pytest.raises(TypeError, match="an object of type list; accepted"):
            publisher.publish(0, 0.0, [1.0], good)
        with pytest.raises(RidgewatchError, match="finite"):
            publisher.publish(0, float("nan"), good, good)
        assert publisher.published == 0


def test_a_ring_that_cannot_be_had_is_a_warning(ring):
    """An error warns once, the publisher is closed, and the solver goes on."""
    x = np.arange(4.0)
    good = np.zeros((4, 4), np.float32)

    def inert(match, *axes, **options):
        with pytest.warns(RuntimeWarning, match=match) as told:
            publisher = Publisher(*axes, **options)
            assert not publisher.is_open and publisher.publish(0, 0.0, good, good) is False
            publisher.close()
        assert len(told) == 1 and publisher.published == 0

    with Publisher(x, x) as publisher:
        inert("nothing will be published: .*another producer", x, x)
        # An invalid step is skipped, and the next one is published.
        with pytest.warns(RuntimeWarning, match="a step was not published: .*finite"):
            assert publisher.publish(0, float("nan"), good, good) is False
        assert publisher.publish(1, 1.0, good, good) and publisher.published == 1
        # Misuse always raises.
        with pytest.raises(ValueError, match="accepted"):
            publisher.publish(2, 2.0, good[:3], good[:3])
    # 5 TB.
    many = np.linspace(0.0, 1.0, 1 << 18)
    inert("no room", many, many, slots=10)
    inert("ascending", x[::-1].copy(), x)
    inert("nothing will be published", x, x, ring="/proc/nowhere")
    os.mkdir(ring)
    os.chmod(ring, 0o777)
    inert("others may write into", x, x)
    # Python's filters may turn the warning into an exception.
    with warnings.catch_warnings(), pytest.raises(RuntimeWarning):
        warnings.simplefilter("error")
        Publisher(x, x)


def test_off_without_a_ring(monkeypatch):
    monkeypatch.delenv("RIDGEWATCH_RING", raising=False)
    with Publisher(np.arange(4.0), np.arange(4.0)) as publisher:
        assert not publisher.is_open
        assert publisher.publish(0, 0.0, np.zeros((4, 4)), np.zeros((4, 4))) is False
