//! Chooses the entry that makes room in a full table: one of the process with the most entries. So a process that fills
//! the table displaces only its own entries. Entries count per process and not per session, because a process may have
//! many sessions.

use std::collections::HashMap;

/// Returns the index of the entry that makes room for one more of process `newcomer`: the oldest of the process that
/// then has the most. `processes` are the processes of the entries, the oldest first.
pub(super) fn makes_room(
    processes: impl Iterator<Item = u32> + Clone,
    newcomer: u32,
) -> Option<usize> {
    let mut counts: HashMap<u32, usize> = HashMap::from([(newcomer, 1)]);
    processes.clone().for_each(|process| *counts.entry(process).or_default() += 1);
    let most = counts.values().max().copied()?;
    let mut processes = processes;
    processes.position(|process| counts.get(&process) == Some(&most))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_entry_of_the_process_that_has_most_makes_room() {
        let of = |processes: &[u32], newcomer| makes_room(processes.iter().copied(), newcomer);
        assert_eq!(of(&[1, 2, 2, 3], 4), Some(1));
        assert_eq!(of(&[1, 2, 3], 3), Some(2), "the newcomer has most");
        assert_eq!(of(&[1, 2, 3], 4), Some(0), "all have the same");
        assert_eq!(of(&[1, 2, 1, 2], 2), Some(1));
        assert_eq!(of(&[], 1), None);
    }
}
