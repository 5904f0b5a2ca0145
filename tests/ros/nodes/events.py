# SPDX-License-Identifier: MIT OR Apache-2.0
"""Publishers and subscriptions with events. Humble's rclpy has no event for a match: there the count is polled."""

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
    HAS_MATCHED = True
except ImportError:
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks
    HAS_MATCHED = False


def publisher(node, kind, topic, profile, matched, **events):
    """Calls `matched` with the number of matched subscriptions whenever it changes."""
    if HAS_MATCHED:
        events['matched'] = lambda event: matched(event.current_count)
    made = node.create_publisher(
        kind, topic, profile, event_callbacks=PublisherEventCallbacks(**events))
    if not HAS_MATCHED:
        _poll(node, made.get_subscription_count, matched)
    return made


def subscription(node, kind, topic, callback, profile, matched, **events):
    """Calls `matched` with the number of matched publishers whenever it changes."""
    if HAS_MATCHED:
        events['matched'] = lambda event: matched(event.current_count)
    made = node.create_subscription(
        kind, topic, callback, profile, event_callbacks=SubscriptionEventCallbacks(**events))
    if not HAS_MATCHED:
        # Humble's subscription does not tell its count. All publishers of the graph count here.
        _poll(node, lambda: node.count_publishers(topic), matched)
    return made


def _poll(node, count, matched):
    last = 0

    def look():
        nonlocal last
        now = count()
        if now != last:
            last = now
            matched(now)

    node.create_timer(0.05, look)
