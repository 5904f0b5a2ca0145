//! Counts, in tests, how often the rules about a peer are looked at. No sample may be a reason for that.

#[cfg(test)]
thread_local! {
    static LOOKS: std::cell::Cell<u64> = const { std::cell::Cell::new(0) };
}

/// How often this thread looked at rules.
#[cfg(test)]
pub(crate) fn looks_at_rules() -> u64 {
    LOOKS.get()
}

/// The rules about a peer are looked at.
pub(in crate::engine) fn note_look() {
    #[cfg(test)]
    LOOKS.set(LOOKS.get() + 1);
}
