# SPDX-License-Identifier: MIT OR Apache-2.0
"""ros2 bag records what is published and plays it again."""

import re
import shutil
import subprocess

import pytest

TOPICS = ('map', 'text', 'image', 'mixed')
NEEDED = ('ros2bag', 'rosbag2_transport', 'rosbag2_storage_sqlite3')


def need_bags():
    """Skip the test where a package is missing."""
    if shutil.which('ros2') is None:
        return
    for package in NEEDED:
        if subprocess.run(['ros2', 'pkg', 'prefix', package], capture_output=True).returncode != 0:
            pytest.skip(f'{package} is not installed')


@pytest.fixture(autouse=True)
def installed():
    need_bags()


def counts(info):
    """How many messages of each topic a bag has."""
    found = re.findall(r'Topic: /(\w+) \|.*?\| Count: (\d+)', info)
    return {topic: int(count) for topic, count in found}


def test_a_recorded_bag_plays_back_unchanged(host, tmp_path):
    bag = tmp_path / 'bag'
    sources = host.node('bag', 'sources')
    sources.said('sent 1')
    recorder = host.start(
        'ros2', 'bag', 'record', '--storage', 'sqlite3', '--disable-keyboard-controls',
        '--all-topics', '--output', bag)
    for topic in TOPICS:
        recorder.said(rf"Subscribed to topic '/{topic}'")
    # It asks for what all publishers of a topic offer.
    latched = host.run('ros2', 'topic', 'info', '--verbose', '--no-daemon', '/map')
    assert len(re.findall('Durability: TRANSIENT_LOCAL', latched)) == 2, latched
    mixed = host.run('ros2', 'topic', 'info', '--verbose', '--no-daemon', '/mixed')
    assert len(re.findall('Reliability: BEST_EFFORT', mixed)) == 2, mixed
    sources.said('sent', count=6, since=len(sources.lines))
    assert recorder.end() == 0
    assert sources.end() == 0

    info = host.run('ros2', 'bag', 'info', '--storage', 'sqlite3', bag)
    recorded = counts(info)
    # The map was published before there was a recorder.
    assert recorded['map'] == 1, info
    assert recorded['text'] >= 4 and recorded['image'] >= 1 and recorded['mixed'] >= 8, info

    listener = host.node('bag', 'listener')
    player = host.start(
        'ros2', 'bag', 'play', '--storage', 'sqlite3', '--disable-keyboard-controls',
        '--start-paused', bag)
    for topic in TOPICS:
        listener.said(f'matched {topic}')
    host.run(
        'ros2', 'service', 'call', '/rosbag2_player/resume', 'rosbag2_interfaces/srv/Resume')
    assert player.wait() == 0, player.output
    listener.said('^map the map$')
    texts = [int(line.split()[1]) for line in listener.said('^text', count=recorded['text'])]
    assert texts == sorted(set(texts)) and len(texts) == recorded['text'], texts
    listener.said('^mixed sure')
    listener.said('^mixed unsure')
    images = [int(line.split()[1]) for line in listener.said(r'^image \d+ whole')]
    assert images == sorted(set(images)), images
    assert 'BROKEN' not in listener.output
