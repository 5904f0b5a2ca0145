# SPDX-License-Identifier: MIT OR Apache-2.0
"""The latencies as a plot, in SVG."""

# In the colours that AXON's other plots have.
COLORS = ['#0969da', '#54aeff', '#cf222e', '#1a7f37', '#9a6700']
TITLES = {
    'latency': 'One host', 'latency, lent': 'One host, fixed-size type, lent',
    'network latency': 'Two network namespaces'}


def save(results, path):
    """Writes `path`; False when matplotlib is missing or there is nothing to show."""
    parts = [part for part in TITLES if any(row['part'] == part for row in results['rows'])]
    try:
        import matplotlib
    except ImportError:
        return False
    if not parts:
        return False
    matplotlib.use('svg')
    # Text as text, and nothing in it that changes from run to run.
    matplotlib.rcParams.update({'svg.fonttype': 'none', 'svg.hashsalt': 'rmw', 'font.size': 9})
    from matplotlib import pyplot

    figure, charts = pyplot.subplots(1, len(parts), figsize=(4.6 * len(parts), 4), squeeze=False)
    for part, chart in zip(parts, charts[0]):
        for rmw, color in zip(results['rmws'], COLORS):
            points = sorted(points_of(results, part, rmw))
            if points:
                chart.loglog(*zip(*points), 'o-', color=color, label=rmw, markersize=3)
        chart.set(title=TITLES[part], xlabel='bytes', ylabel='p50, us')
        chart.grid(color='#d8dee4')
        chart.legend()
    figure.suptitle('Latency from publish to callback, two processes of rclcpp')
    figure.tight_layout()
    figure.savefig(path, metadata={'Date': None, 'Creator': None})
    return True


def points_of(results, part, rmw):
    """(bytes, p50 in microseconds) of the streams at the usual pace."""
    for row in results['rows']:
        if (row['part'], row['rmw']) == (part, rmw) and 'p50_us' in row:
            size, pace = row['row'].split(', ')
            # Of two paces of one size the slower is like those of the other sizes.
            if pace != '1000 Hz':
                yield int(size.split()[0]), row['p50_us']
