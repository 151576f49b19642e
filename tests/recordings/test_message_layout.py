"""Numbers read from the bytes of ROS messages, against those that `rosbags` puts in and takes out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from forcegp.errors import FileFormatError
from forcegp.recordings.message_layout import message_layout

typesys = pytest.importorskip("rosbags.typesys")
ROS1 = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
ROS2 = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
WORDS = st.text(alphabet="abcé_/", max_size=9)
VALUES = st.floats(-1e6, 1e6)


def stamped(store, frame, sec=5, nanosec=7):
    own = {"stamp": store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec), "frame_id": frame}
    return store.types["std_msgs/msg/Header"](**own, **({"seq": 3} if store is ROS1 else {}))


def joint_state(store, frame, names, positions, efforts=()):
    arrays = (np.array(values, dtype=np.float64) for values in (positions, (), efforts))
    position, velocity, effort = arrays
    kind = store.types["sensor_msgs/msg/JointState"]
    return kind(header=stamped(store, frame), name=list(names), position=position, velocity=velocity, effort=effort)


def written(store, message, big=False):
    if store is ROS1:
        return bytes(store.serialize_ros1(message, message.__msgtype__))
    return bytes(store.serialize_cdr(message, message.__msgtype__, little_endian=not big))


def read(store, message, raws):
    """Columns of these raw messages, which have the layout of the first."""
    layout = message_layout(raws[0], message.__msgtype__, store.fielddefs, ros1=store is ROS1)
    table = np.stack([np.frombuffer(raw, np.uint8) for raw in raws])
    assert layout.fits(table).all()
    return {name: values.tolist() for name, values in layout.columns(table, {n: n for n in layout.places}).items()}


@pytest.mark.parametrize("store", [ROS1, ROS2], ids=["ROS 1", "ROS 2"])
@given(frame=WORDS, names=st.lists(WORDS.filter(bool), min_size=1, max_size=4, unique=True), data=st.data())
def test_joint_states_of_any_names(store, frame, names, data):
    positions = data.draw(st.lists(VALUES, min_size=len(names), max_size=len(names)))
    message = joint_state(store, frame, names, positions, positions[::-1])
    found = read(store, message, [written(store, message)])
    expected = {f"position.{name}": [value] for name, value in zip(names, positions, strict=True)}
    expected |= {f"effort.{name}": [value] for name, value in zip(names, positions[::-1], strict=True)}
    assert {name: value for name, value in found.items() if not name.startswith("header.")} == expected
    assert found["header.stamp"] == [5_000_000_007]


@pytest.mark.parametrize("big", [False, True], ids=["little-endian", "big-endian"])
def test_numbers_of_every_size_beside_each_other(big):
    """Alignment is where such code goes wrong: 1, 2, 4 and 8 bytes, nested structs, fixed and free arrays, texts."""
    types = typesys.get_types_from_msg(
        "bool flag\nfloat64 d\nint8 small\nint16[3] shorts\nstring text\nfloat32 f\nuint8 c\nInner[] inner\n"
        "uint64 large\nint64 negative\nfloat64[] free\nstring[] words\nuint32 last",
        "test_msgs/msg/Outer",
    ) | typesys.get_types_from_msg("int8 a\nfloat64 b", "test_msgs/msg/Inner")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    store.register(types)
    inner = store.types["test_msgs/msg/Inner"]
    message = store.types["test_msgs/msg/Outer"](
        flag=True,
        d=0.1,
        small=-3,
        shorts=np.array([1, -2, 300], np.int16),
        text="odd",
        f=0.25,
        c=200,
        inner=[inner(a=1, b=1.5), inner(a=-1, b=2.5)],
        large=2**40,
        negative=-(2**40),
        free=np.array([3.5, 4.5]),
        words=["a", "long word"],
        last=77,
    )
    assert read(store, message, [written(store, message, big)]) == {
        "flag": [1],
        "d": [0.1],
        "small": [-3],
        "shorts[0]": [1],
        "shorts[1]": [-2],
        "shorts[2]": [300],
        "f": [0.25],
        "c": [200],
        "inner[0].a": [1],
        "inner[0].b": [1.5],
        "inner[1].a": [-1],
        "inner[1].b": [2.5],
        "large": [2.0**40],
        "negative": [-(2**40)],
        "free[0]": [3.5],
        "free[1]": [4.5],
        "last": [77],
    }


def test_messages_of_one_layout_are_read_at_once_and_others_do_not_fit():
    messages = [joint_state(ROS2, "base", ("a", "b"), (row, -row)) for row in (1.0, 2.0, 3.0)]
    raws = [written(ROS2, message) for message in messages]
    assert read(ROS2, messages[0], raws)["position.b"] == [-1.0, -2.0, -3.0]
    layout = message_layout(raws[0], messages[0].__msgtype__, ROS2.fielddefs, ros1=False)
    for other in (("b", "a"), ("a", "c")):
        swapped = written(ROS2, joint_state(ROS2, "base", other, (1.0, 2.0)))
        assert len(swapped) == len(raws[0])
        assert not layout.fits(np.frombuffer(swapped, np.uint8)[None, :]).any()
    renamed = written(ROS2, joint_state(ROS2, "tool", ("a", "b"), (1.0, 2.0)))  # the frame moves no number
    assert layout.fits(np.frombuffer(renamed, np.uint8)[None, :]).all()


@given(st.integers(0, 60))
def test_a_message_that_ends_early_is_refused(length):
    message = joint_state(ROS2, "base", ("a", "b"), (1.0, 2.0))
    with pytest.raises(FileFormatError):
        message_layout(written(ROS2, message)[:length], message.__msgtype__, ROS2.fielddefs, ros1=False)


@given(st.binary(min_size=4, max_size=200))
def test_any_bytes_are_a_message_or_refused(raw):
    try:
        layout = message_layout(raw, "sensor_msgs/msg/JointState", ROS2.fielddefs, ros1=False)
    except FileFormatError:
        return
    assert all(offset + 4 <= len(raw) for offset, _ in layout.places.values())
