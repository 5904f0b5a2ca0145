//! What axon-tls does around its glue. This process may keep what it knows: only the child's memory is looked at.

pub(crate) fn erasing_stack<T>(work: impl FnOnce() -> T) -> T {
    work()
}

pub(crate) fn erasing_stack_of_packet<T>(work: impl FnOnce() -> T) -> T {
    work()
}
