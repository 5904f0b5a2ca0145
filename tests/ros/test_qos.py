# SPDX-License-Identifier: MIT OR Apache-2.0
"""Quality of service between processes, and what is told of it."""

import pytest

MILLISECOND = 1_000_000


def test_a_deadline_that_is_missed_is_told_at_both_ends(host):
    deadline = f'deadline={100 * MILLISECOND}'
    subscription = host.node('qos', 'subscription', 0, deadline)
    # It falls silent after three.
    publisher = host.node('qos', 'publisher', 3, 0.05, deadline)
    subscription.said('heard 3')
    publisher.said('offered deadline missed')
    subscription.said('requested deadline missed', count=2)


def test_messages_that_outlived_their_lifespan_are_not_taken(host):
    # All five are old when taking begins.
    subscription = host.node('qos', 'subscription', 2, 'transient_local')
    publisher = host.node(
        'qos', 'publisher', 5, 0.01, 'transient_local', f'lifespan={200 * MILLISECOND}')
    publisher.said('published 5')
    subscription.said('taking')
    # The next that comes is the first that is heard.
    host.node('qos', 'publisher', 1, 1, 'transient_local')
    assert subscription.said('heard') == ['heard 1']


def test_a_publisher_that_asserts_its_liveliness_no_more_is_told_of(host):
    lease = f'lease={500 * MILLISECOND}'
    subscription = host.node('qos', 'subscription', 0, lease)
    publisher = host.node('qos', 'publisher', 5, 0.1, lease, 'manual')
    subscription.said('alive 1, not alive 0')
    publisher.said('liveliness lost 1')
    subscription.said('alive 0, not alive 1')
    # It is lost once, however long the silence lasts.
    subscription.said('alive', count=2)
    assert 'liveliness lost 2' not in publisher.output


def test_a_publisher_that_is_killed_is_alive_no_more(host):
    subscription = host.node('qos', 'subscription', 0, f'lease={2000 * MILLISECOND}')
    publisher = host.node('qos', 'publisher', 100000, 0.1, f'lease={1000 * MILLISECOND}')
    subscription.said('alive 1, not alive 0')
    subscription.said('matched 1')
    publisher.kill()
    subscription.said('alive 0, not alive 0')
    subscription.said('matched 0')


@pytest.mark.parametrize('offered, requested, policy', [
    (['best_effort'], [], 'RELIABILITY'),
    ([], ['transient_local'], 'DURABILITY'),
    ([], ['deadline=100000000'], 'DEADLINE'),
    ([], ['lease=100000000'], 'LIVELINESS'),
    (['lease=1000000000'], ['lease=1000000000', 'manual'], 'LIVELINESS'),
])
def test_incompatible_qos_is_reported_at_both_ends(host, offered, requested, policy):
    subscription = host.node('qos', 'subscription', 0, *requested)
    publisher = host.node('qos', 'publisher', 100000, 0.1, *offered)
    kinds = {'DURABILITY': 2, 'DEADLINE': 4, 'LIVELINESS': 8, 'RELIABILITY': 16}
    told = rf'incompatible .*({policy}|\b{kinds[policy]}\b)'
    publisher.said('offered ' + told)
    subscription.said('requested ' + told)
    publisher.said('published', count=5)
    assert 'heard' not in subscription.output and 'matched' not in publisher.output
