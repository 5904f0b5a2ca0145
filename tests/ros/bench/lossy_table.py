# SPDX-License-Identifier: MIT OR Apache-2.0
"""The results over a path that loses packets as tables, in Markdown: a line for each implementation."""

from table import cell

FRESH_MS = 250


def share(figure):
    return lambda row: f'{row[figure]:.1f}'


def delivered(row):
    """Megabits a second, and the median age."""
    if row['median_ms'] is None:
        return '0'
    late = ' (late)' if row['median_ms'] > FRESH_MS else ''
    return f"{row['mbits']:.1f}, {row['median_ms']:.0f} ms{late}"


TABLES = [
    ('1 KB, RELIABLE', 'within 100 ms, %', share('within_100_ms')),
    ('1 KB, RELIABLE', 'within 300 ms, %', share('within_300_ms')),
    ('64 KB, RELIABLE', 'within 100 ms, %', share('within_100_ms')),
    ('1 KB, BEST_EFFORT', 'within 100 ms, %', share('within_100_ms')),
    ('512 KB, RELIABLE', 'Mbit/s delivered, median age', delivered),
]


def render(results):
    losses = sorted({row['loss'] for row in results['rows']})
    names = list(dict.fromkeys(row['rmw'] for row in results['rows']))
    cells = {(row['rmw'], row['loss'], row['message']): row for row in results['rows']}
    machine = ', '.join(f'{name} {value}' for name, value in results['machine'].items())
    lines = [machine, '']
    for message, title, text in TABLES:
        lines += [f'| {message}, {title} | ' + ' | '.join(f'{loss:g} %' for loss in losses) + ' |',
                  '| --- ' + '| --: ' * len(losses) + '|']
        for name in names:
            of_losses = [cell(cells.get((name, loss, message)), text) for loss in losses]
            lines.append(f'| {name} | ' + ' | '.join(of_losses) + ' |')
        lines.append('')
    return '\n'.join(lines)
