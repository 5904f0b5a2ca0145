# SPDX-License-Identifier: MIT OR Apache-2.0
"""The results as a table, in Markdown."""


def with_daemons(r):
    """CPU time of a message in microseconds, in the applications and in AXON's daemons."""
    return r['cpu_us_a_message'] + 1e6 * r['daemon_cores'] / max(r['per_second'], 1e-9)


# Of each part: (column, how it is computed from a result)
FIGURES = {
    'latency': [
        ('p50 / p99 us', lambda r: f"{r['p50_us']:.0f} / {r['p99_us']:.0f}"),
        ('CPU us a message', lambda r: f"{r['cpu_us_a_message']:.0f}"),
        ('with daemons', lambda r: f"{with_daemons(r):.0f}"),
        ('received', lambda r: f"{100 * r['received'] / max(r['sent'], 1):.1f} %"),
        ('MB a process', lambda r: f"{sum(r['pss_kib']) / 2048:.1f}")],
    'throughput': [
        ('messages/s received', lambda r: f"{r['per_second']:.0f}"),
        ('GB/s', lambda r: f"{r['gb_per_second']:.2f}"),
        ('received', lambda r: f"{100 * r['received'] / max(r['sent'], 1):.1f} %"),
        ('CPU us a message', lambda r: f"{r['cpu_us_a_message']:.1f}"),
        ('with daemons', lambda r: f"{with_daemons(r):.1f}")],
    'first message': [('ms', lambda r: f"{r['first_ms']:.1f}")],
    'launch': [
        ('whole after s', lambda r: f"{r['since_last_created_s']:.1f}"),
        ('% of a core at rest', lambda r: f"{100 * r['cores_at_rest']:.2f}"),
        ('MB a process', lambda r: f"{r['pss_kib_a_process'] / 1024:.1f}")],
}
FIGURES['latency, lent'] = FIGURES['network latency'] = FIGURES['latency']
FIGURES['network throughput'] = FIGURES['throughput']


def render(results):
    """A table a part: a line for each row and figure, a column for each implementation."""
    rmws = results['rmws']
    cells = {(r['part'], r['row'], r['rmw']): r for r in results['rows']}
    parts = list(dict.fromkeys(r['part'] for r in results['rows']))
    machine = ', '.join(f'{name} {value}' for name, value in results['machine'].items())
    lines = [machine, '']
    for part in parts:
        lines += [f'| {part} | | ' + ' | '.join(rmws) + ' |', '| --- ' * (2 + len(rmws)) + '|']
        for row in dict.fromkeys(r['row'] for r in results['rows'] if r['part'] == part):
            for figure, text in FIGURES[part]:
                values = [cell(cells.get((part, row, rmw)), text) for rmw in rmws]
                lines.append(f'| {row} | {figure} | ' + ' | '.join(values) + ' |')
        lines.append('')
    return '\n'.join(lines)


def cell(result, text):
    if result is None:
        return '-'
    return result['failed'] if 'failed' in result else text(result)
