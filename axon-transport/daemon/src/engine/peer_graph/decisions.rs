//! Counts, in tests, how often the rules about a peer are evaluated. A sample must never cause an evaluation.

#[cfg(test)]
thread_local! {
    static LOOKS: std::cell::Cell<u64> = const { std::cell::Cell::new(0) };
}

/// Returns how often this thread evaluated rules.
#[cfg(test)]
pub(crate) fn looks_at_rules() -> u64 {
    LOOKS.get()
}

/// Records an evaluation of the rules about a peer.
pub(in crate::engine) fn note_look() {
    #[cfg(test)]
    LOOKS.set(LOOKS.get() + 1);
}
