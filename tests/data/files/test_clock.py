import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data import read_tum
from dvo.data.files.clock import PARTS, clock_of_names, clock_of_rows
from dvo.data.files.listing import listed_files
from dvo.data.files.stamps import read_times
from dvo.data.readers.groundtruth import read_groundtruth


@given(
    st.sampled_from(["ms", "us", "ns"]), st.floats(8, 200), st.sampled_from([0.0, 12.5, 4000.0, 1.3e9, 1.7e9]),
    st.integers(2, 40),
)  # fmt: skip
@example("us", 30.0, 1.3e9, 60)
@example("ms", 30.0, 0.0, 60)
def test_whole_numbers_of_any_unit_and_clock(unit, rate, start, count):
    seconds = start + np.arange(count) / rate
    texts = [str(round(value * PARTS[unit])) for value in seconds.tolist()]
    found = clock_of_rows([[text] for text in texts])
    assert found.unit == unit
    np.testing.assert_allclose(found.seconds, seconds, atol=0.6e-3)


@given(st.floats(0.2, 1000), st.sampled_from([0.0, 7.25, 1.3e9, 1.7e9]), st.integers(2, 40))
def test_decimal_seconds_stay_seconds(rate, start, count):
    seconds = start + np.arange(count) / rate
    found = clock_of_rows([[f"{value:.6f}"] for value in seconds.tolist()])
    assert found.unit == "s"
    np.testing.assert_allclose(found.seconds, seconds, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("00000 1305031102.175304 4.1\n00001 1305031102.211214 4.0\n", [0, 0.03591]),  # DSO, TUM-mono
        ("a.png,1305031102175\nb.png,1305031102211\n", [0, 0.036]),
        ("#frame exposure_ms stamp_us\n1 4 1000\n2 5 34000\n", [0, 0.033]),
        ("time [ms]\n0\n2\n4\n", [0, 0.002, 0.004]),
        ("time [s]\n0\n40\n80\n", [0, 40, 80]),
        ("2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.697\n", [0, 0.10264]),  # KITTI raw
        ("secs,nsecs\n5,900000000\n6,5\n", [0, 0.1]),
        ("1305031102 90000000\n1305031102 190000000\n", [0, 0.1]),
        ("1305031102 90000\n1305031102 190000\n1305031103 5000\n", [0, 0.1, 0.915]),
        ("1305031102 90\n1305031102 190\n1305031103 5\n", [0, 0.1, 0.915]),
        ("tv_sec,tv_usec\n5,900000\n6,5\n", [0, 0.100005]),
        ("0.000\n16.683\n33.367\n", [0, 0.01668, 0.03337]),
        ("33333333\n66666667\n", [0, 0.03333]),
        ("0\n1\n2\n", [0, 1, 2]),
        ("133000000000000000\n133000000000333333\n", [0, 0.0333333]),  # ticks of Windows, of a HoloLens
        ("ticks\n638000000000000000\n638000000000333333\n", [0, 0.0333333]),  # of .NET
        (",time\n0,0.5\n1,0.6\n", [0, 0.1]),  # pandas
    ],
)
def test_columns_headers_and_units(make, text, expected):
    times = read_times(make.text("t.csv", text), None)
    np.testing.assert_allclose(times - times[0], expected, atol=1e-5)


def test_what_is_not_plain_seconds_is_said(make):
    notes = []
    read_times(make.text("t.csv", "0\n33333\n66667\n"), 3, notes)
    assert "microseconds" in notes[0] and "30 a second" in notes[0] and "t.csv" in notes[0]
    notes.clear()
    read_times(make.text("t.csv", "0.5\n0.6\n"), 2, notes)
    assert notes == []


@pytest.mark.parametrize("stems", [["1", "2", "3"], ["000010", "000020"], ["a", "b"], ["clip2_0001", "clip2_0002"], []])
def test_numbers_of_frames_are_no_times(stems):
    assert clock_of_names(stems) is None


HEADERS = {
    "#timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z": "33333333,1,2,3,.9,.1,.2,.3",
    "qw,qx,qy,qz,x,y,z,t": ".9,.1,.2,.3,1,2,3,.033333333",
    "time_us tx[mm] ty[mm] tz[mm] qx qy qz qw": "33333.333 1000 2000 3000 .1 .2 .3 .9",
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]":
        "33333333,1,2,3,.9,.1,.2,.3,8",
    "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,field.pose.orientation.x,"
    "field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w": "33333333,1,2,3,.1,.2,.3,.9",
    "#timestamp [ns], vertex index, p_G_Ix [m], p_G_Iy [m], p_G_Iz [m], q_G_Iw, q_G_Ix, q_G_Iy, q_G_Iz, v_x, v_y, v_z":
    "33333333,7,1,2,3,.9,.1,.2,.3,4,5,6",
    "time [s],idx,posx,posy,posz,rotx,roty,rotz,rotw,max": ".033333333,7,1,2,3,.1,.2,.3,.9,8",
    "sec,nsec,x,y,z,qx,qy,qz,qw": "0,33333333,1,2,3,.1,.2,.3,.9",
    ",t_ns,x,y,z,qx,qy,qz,qw": "7,33333333,1,2,3,.1,.2,.3,.9",
    "graph_uid,tracking_timestamp_ns,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device,qx_world_device,"
    "qy_world_device,qz_world_device,qw_world_device,device_linear_velocity_x_device,gravity_x_world":
    "a-b,33333333,99,1,2,3,.1,.2,.3,.9,4,5",
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.child_frame_id,field.pose.pose.position.x,"
    "field.pose.pose.position.y,field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
    "field.pose.pose.orientation.z,field.pose.pose.orientation.w": "99,7,33333333,map,camera,1,2,3,.1,.2,.3,.9",
}  # fmt: skip


@pytest.mark.parametrize("header", HEADERS)
def test_poses_under_a_header(make, header):
    later = HEADERS[header].replace("33333333,", "66666667,").replace(".033333333", ".066666667")
    later = later.replace("33333.333", "66666.667")
    found = read_groundtruth(make.text("t.csv", f"{header}\n{HEADERS[header]}\n{later}\n"), np.zeros(2))
    np.testing.assert_allclose(found.timestamps, [1 / 30, 2 / 30], atol=1e-8)
    quaternion = np.array([0.1, 0.2, 0.3, 0.9]) / np.sqrt(0.95)
    np.testing.assert_allclose(found.poses_wc, [[1, 2, 3, *quaternion]] * 2, atol=1e-12)


def test_truths_of_droid_in_nanoseconds(make):
    rows = [f"{1.403636580838555648e18 + 5e6 * i:.6f} {i} 0 0 0 0 0 1\n" for i in range(4)]
    found = read_tum(make.text("a.txt", "".join(rows)))
    np.testing.assert_allclose(found.timestamps, 1403636580.838555648 + 0.005 * np.arange(4), atol=1e-6)
    rows = [f"{1.403636580838555648e18 + 5e6 * i:.18e} {i} 0 0 0 0 0 1\n" for i in range(4)]
    np.testing.assert_array_equal(read_tum(make.text("b.txt", "".join(rows))).timestamps, found.timestamps)


def test_rows_of_nan_have_no_pose(make):
    nan = " ".join(["nan"] * 7)
    file = make.text("t.txt", f"0.0 0 0 0 0 0 0 1\n0.1 {nan}\n0.2 NaN NaN NaN 0 0 0 1\n0.3 3 0 0 0 0 0 1\n")
    assert read_tum(file).timestamps.tolist() == [0, 0.3]
    with pytest.raises(DvoError, match="line 2: not a TUM row"):
        read_tum(make.text("t.txt", "0.0 0 0 0 0 0 0 1\n0.1 nan 0 0 0 0 0 1\n"))
    with pytest.raises(DvoError, match="all rows are NaN"):
        read_tum(make.text("t.txt", f"0.1 {nan}\n"))


@pytest.mark.parametrize("last", ["", " 0 0 0 1"])
def test_a_time_and_a_matrix_in_a_row(make, last):
    rows = [f"{i / 10:.1f} 0 -1 0 {i} 1 0 0 2 0 0 1 3{last}\n" for i in range(4)]
    rows[2] = "0.2 " + " ".join(["-inf"] * 12) + last + "\n"  # ScanNet's frames without a pose
    expected = [[i, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)] for i in (0, 1, 3)]
    found = read_tum(make.text("t.txt", "".join(rows)))
    assert found.timestamps.tolist() == [0, 0.1, 0.3]
    np.testing.assert_allclose(found.poses_wc, expected, atol=1e-12)
    rows = [row.split(" ", 1)[1] for row in rows[:2]]
    counted = read_groundtruth(make.text("k.txt", "".join(rows)), np.array([5.0, 6.0]))
    np.testing.assert_allclose(counted.poses_wc, expected[:2], atol=1e-12)
    with pytest.raises(DvoError, match="line 1: (the matrix is no rotation|the last row of the matrix)"):
        read_groundtruth(make.text("k.txt", "1 0 0 0 0 1 0 0 0 0 " + ("1 0 1 0 0 1" if last else "2 0")), np.zeros(1))


def test_a_time_and_a_matrix_column_by_column(make):
    rows = [f"{i / 10:.1f} 0 1 0 0 -1 0 0 0 0 0 1 0 {i} 2 3 1\n" for i in range(4)]
    found = read_tum(make.text("arkit.txt", "".join(rows)))
    expected = [[i, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)] for i in range(4)]
    np.testing.assert_allclose(found.poses_wc, expected, atol=1e-12)


def test_seventeen_numbers_are_euroc_s_only_with_nanoseconds(make):
    state = "1 2 3 .9 .1 .2 .3 " + "0 " * 9
    for time in ("1403636580838555648", "1.403636580838555648e+18"):
        found = read_tum(make.text("t.txt", f"{time} {state}\n"))
        assert found.timestamps[0] == pytest.approx(1403636580.838555648) and found.poses_wc[0, 6] > 0.9
    with pytest.raises(DvoError, match="line 1: 17 numbers without a header.*Name the columns"):
        read_tum(make.text("t.txt", f"1403636580.838555 {state}\n"))


def test_times_that_have_lost_their_digits(make):
    rows = [f"{1403636580 + 0.05 * i:.5e} {i} 0 0 0 0 0 1\n" for i in range(9)]
    with pytest.raises(DvoError, match="line 2: 8 of 9 rows have the time of the row before.*all their digits"):
        read_tum(make.text("t.txt", "".join(rows)))
    assert len(read_tum(make.text("t.txt", rows[0] * 9))) == 1  # of TUM's own, some rows stand twice


def test_times_in_days_are_no_seconds(make):
    rows = "".join(f"{45322.5 + 0.05 * i / 86400:.10f}\n" for i in range(9))
    with pytest.raises(DvoError, match="times: 1,7.*images a second"):
        read_times(make.text("t.csv", rows), 9)


def test_quotes_around_fields(make):
    file = make.text("t.csv", '"qw","qx","qy","qz","x","y","z","time [ms]"\n' + '".9",.1,.2,.3,1,2,3,"40"\n')
    found = read_tum(file)
    assert found.timestamps.tolist() == [0.04] and found.poses_wc[0, :3].tolist() == [1, 2, 3]
    times = make.text("times.csv", '"frame","time"\n"0","0.5"\n"1","0.7"\n')
    assert read_times(times, 2).tolist() == [0.5, 0.7]


@pytest.mark.parametrize("header", ["time,roll,pitch,yaw,x,y,z,w_x", "frame,tx,ty,tz,qx,qy,qz,qw", "a,b,c,d,e,f,g,h"])
def test_headers_without_a_pose_are_named(make, header):
    with pytest.raises(DvoError, match="header: the header .* does not name a time, a position and a quaternion"):
        read_tum(make.text("t.csv", f"{header}\n1,2,3,4,5,6,7,8\n"))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("t,tcw_x,tcw_y,tcw_z,qx,qy,qz,qw", "column 'tcw_x': poses of the world in the camera"),
        ("t,x,y,z,q_cw_x,q_cw_y,q_cw_z,q_cw_w", "column 'q_cw_x': poses of the world in the camera"),
        ("t,gt_x,gt_y,gt_z,gt_qx,gt_qy,gt_qz,gt_qw,x,y,z,qx,qy,qz,qw", "two trajectories, 'gt_x' and 'x'"),
    ],
)
def test_headers_of_other_poses_are_refused(make, header, said):
    row = ",".join(["0", *["1,2,3,0,0,0,1"] * (header.count(",") // 7)])
    with pytest.raises(DvoError, match=said):
        read_tum(make.text("t.csv", f"{header}\n{row}\n"))


def test_an_empty_field_shifts_no_columns(make):
    file = make.text("t.csv", "time,frame,x,y,z,qx,qy,qz,qw\n1,,1,2,3,0,0,0,1\n")
    with pytest.raises(DvoError, match="names 9 columns, this row has 8"):
        read_tum(file)


def test_relative_milliseconds_of_a_truth_follow_the_images(make):
    file = make.text("t.txt", "".join(f"{round(1000 * i / 30)} {i} 0 0 0 0 0 1\n" for i in range(10)))
    found = read_groundtruth(file, np.arange(10) / 30)
    np.testing.assert_allclose(found.timestamps, np.arange(10) / 30, atol=1e-3)


@pytest.mark.parametrize("base", [0, 1])
@pytest.mark.parametrize("last", ["", " 0 0 0 1"])
def test_numbers_of_images_in_place_of_times(make, base, last):
    """KITTI-360 has them before its matrices, with gaps; others before a quaternion."""
    images = 1e9 + np.arange(12) / 30
    file = make.text("k.txt", "".join(f"{i} 1 0 0 {i} 0 1 0 0 0 0 1 0{last}\n" for i in (1, 3, 4, 9)))
    notes: list[str] = []
    found = read_groundtruth(file, images, notes)
    assert found.timestamps.tolist() == images[[1, 3, 4, 9]].tolist() and found.poses_wc[:, 0].tolist() == [1, 3, 4, 9]
    assert len(notes) == 1 and "numbers of images, from 0" in notes[0]
    file = make.text("t.txt", "".join(f"{i + base:.18e} {i} 0 0 0 0 0 1\n" for i in range(12)))
    assert read_groundtruth(file, images).timestamps.tolist() == images.tolist()


def test_whole_seconds_stay_seconds(make):
    file = make.text("t.txt", "".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(10)))
    notes: list[str] = []
    assert read_groundtruth(file, np.arange(300) / 30, notes).timestamps.tolist() == list(range(10)) and not notes


def test_as_many_poses_as_images_in_another_span(make):
    file = make.text("t.txt", "".join(f"{i / 10} {i} 0 0 0 0 0 1\n" for i in range(10)))
    notes: list[str] = []
    read_groundtruth(file, np.arange(10) / 10.1, notes)
    assert not notes
    assert len(read_groundtruth(file, np.arange(10) / 20, notes)) == 10
    assert len(notes) == 1 and "span 0.9 s and the images 0.45 s" in notes[0]


def test_rows_of_vins_without_a_header_are_refused(make):
    row = "33333333{},1,2,3,.9,.1,.2,.3,\n"
    with pytest.raises(DvoError, match="line 1: 8 numbers without a header, and a comma behind them") as caught:
        read_tum(make.text("vio.csv", row.format(0) + row.format(1)))
    assert "timestamp,tx,ty,tz,qw,qx,qy,qz" in str(caught.value.remedy)
    found = read_tum(make.text("vio.csv", "timestamp,tx,ty,tz,qw,qx,qy,qz\n" + row.format(0)))
    assert found.poses_wc[0, 6] == pytest.approx(0.9 / np.sqrt(0.95))


T0 = 1_700_000_000.25 + np.arange(60) / 30


@pytest.mark.parametrize("form", ["{0}_{1:09d}", "{0}_{1}", "{0}-{2:06d}", "{0}_{2}", "left_{0}_{3:03d}", "{0}.{1}"])
def test_seconds_and_their_parts_in_names(form):
    """Also with a point between two numbers, where nanoseconds have lost the zeros that they begin with."""
    wholes = np.floor(T0).astype(int)
    rests = [np.floor((T0 - wholes) * parts + 1e-6).astype(int) for parts in (10**9, 10**6, 10**3)]
    stems = [form.format(*row) for row in zip(wholes.tolist(), *(rest.tolist() for rest in rests), strict=True)]
    found = clock_of_names(stems)
    np.testing.assert_allclose(found.seconds, T0, rtol=0, atol=1.1e-3)
    assert (found.note("them") is not None) == (form == "{0}.{1}")


@pytest.mark.parametrize("form", ["{0}_{1}", "{0}_{1:03d}", "{0}_{2:06d}", "{0}_{3}"])
def test_numbers_of_images_behind_a_second_are_no_parts_of_it(form):
    """Counted in the second or from the first image on, all of them or every fifth."""
    rows = [(1_700_000_000 + k // 30, k % 30, k, 5 * k) for k in range(90)]
    found = clock_of_names([form.format(*row) for row in rows])
    assert found is None or (found.seconds == [row[0] for row in rows]).all()


def test_decimals_without_their_last_zeros_are_plain():
    assert clock_of_names([f"{t:.6f}".rstrip("0") for t in T0]).note("them") is None


@pytest.mark.parametrize(("unit", "metres"), [("[m]", 1), ("[mm]", 1e-3), ("(ft)", 0.3048), ("(world)", 1)])
def test_the_unit_of_positions(make, unit, metres):
    header = f"time,x {unit},y {unit},z {unit},qx,qy,qz,qw\n"
    found = read_tum(make.text("t.csv", header + "0.5,1,2,3,0,0,0,1\n"))
    np.testing.assert_allclose(found.positions, [[metres, 2 * metres, 3 * metres]])
    with pytest.raises(DvoError, match="positions in several units: x"):
        read_tum(make.text("t.csv", f"time,x [mm],y [m],z {unit},qx,qy,qz,qw\n0.5,1,2,3,0,0,0,1\n"))


def test_lists_whose_fractions_have_lost_zeros_are_refused(make):
    rows = "".join(f"{int(t)}.{round(t % 1 * 1e9)} rgb/{k}.png\n" for k, t in enumerate(T0))
    poses = rows.replace("rgb/", "0 0 0 0 0 0 1 # ")
    for read, text in ((listed_files, rows), (read_tum, poses), (lambda file: read_times(file, None), poses)):
        with pytest.raises(DvoError, match="fractions of seconds that have lost their leading zeros"):
            read(make.text("rgb.txt", text))


def test_poses_with_seconds_and_microseconds(make):
    rows = "".join(f"{int(t)},{round(t % 1 * 1e6)},0,0,0,0,0,0,1\n" for t in T0)
    found = read_tum(make.text("t.csv", "sec,usec,x,y,z,qx,qy,qz,qw\n" + rows))
    np.testing.assert_allclose(found.timestamps, T0, rtol=0, atol=2e-6)
