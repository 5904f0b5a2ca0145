# SPDX-License-Identifier: MIT OR Apache-2.0
"""Much at once: large, many and often. How fast is the benchmarks' affair; here it is to be right."""

from conftest import until


def test_images_of_a_4k_camera_at_30_hertz_come_whole(host):
    viewers = [host.node('images', 'viewer') for _ in range(2)]
    host.node('images', 'camera', 30)
    for viewer in viewers:
        viewer.said(r'image \d+ whole', count=30)
        numbers = [int(line.split()[1]) for line in viewer.said('image')]
        assert numbers == sorted(set(numbers)), numbers
        assert 'BROKEN' not in viewer.output


def test_thirty_publishers_of_tf_are_all_heard(host):
    listeners = [host.node('transforms', 'listener', 30) for _ in range(2)]
    for first in range(0, 30, 10):
        host.node('transforms', 'joints', first, 10).said('publishing')
    for listener in listeners:
        listener.said('heard all')
        assert 'BROKEN' not in listener.output
    until(
        lambda: host.shows('Publisher count: 30', 'ros2', 'topic', 'info', '/tf', '--no-daemon'),
        'the graph has thirty')


def test_a_clock_of_1000_hertz_is_never_behind_itself(host):
    users = [host.node('clock', 'user') for _ in range(3)]
    host.node('clock', 'simulator')
    for user in users:
        user.said(r'time [1-9]', count=10)
        assert 'BACKWARDS' not in user.output
