//! One writer's messages by way of several readers of its ring, as where some ask for more of it than
//! others, or came later: in the order of their numbers, and each once.

/// What a look for a writer's next message finds.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Next<T> {
    /// This one.
    Taken(T),
    /// One that came before by way of another reader, which has passed over it.
    Repeated,
    /// None of the readers has one.
    Nothing,
}

/// The next message of a writer: the first that any of the `readers` has, by way of the first of those
/// that have it. `number` says which one a reader has next, `take` takes it. `sent` is the number of the
/// newest that was handed out, 0 before the first.
///
/// A reader passes over what came by way of another when it is its turn, never before: those that go on
/// alone, because the others end, have all that was not handed out.
pub(crate) fn next<R, T>(
    readers: &[R],
    sent: &mut u64,
    number: impl Fn(&R) -> Option<u64>,
    take: impl FnOnce(&R) -> Option<(u64, T)>,
) -> Next<T> {
    let look = || {
        let numbers = readers.iter().map(&number).enumerate();
        numbers.filter_map(|(at, number)| Some((number?, at))).min()
    };
    let reader = match readers {
        [only] => only,
        // A reader that was looked at before the others may have got something earlier since. What
        // was written before what the first look found is there by now: the second finds it.
        _ => match look().and_then(|_| look()) {
            Some((_, first)) => &readers[first],
            None => return Next::Nothing,
        },
    };
    match take(reader) {
        Some((number, taken)) if number > *sent => {
            *sent = number;
            Next::Taken(taken)
        }
        Some(_) => Next::Repeated,
        None => Next::Nothing,
    }
}

#[cfg(test)]
mod tests {
    use std::{cell::RefCell, collections::VecDeque};

    use super::*;

    type Readers = [RefCell<VecDeque<u64>>];

    fn step(readers: &Readers, sent: &mut u64) -> Next<u64> {
        let take = |reader: &RefCell<VecDeque<u64>>| {
            let number = reader.borrow_mut().pop_front()?;
            Some((number, number))
        };
        next(readers, sent, |reader| reader.borrow().front().copied(), take)
    }

    fn all(readers: &Readers, sent: &mut u64) -> Vec<u64> {
        let mut taken = Vec::new();
        loop {
            match step(readers, sent) {
                Next::Taken(number) => taken.push(number),
                Next::Repeated => {}
                Next::Nothing => return taken,
            }
        }
    }

    fn readers<const N: usize>(numbers: [&[u64]; N]) -> [RefCell<VecDeque<u64>>; N] {
        numbers.map(|numbers| RefCell::new(numbers.iter().copied().collect()))
    }

    #[test]
    fn what_waits_with_an_older_reader_goes_before_what_a_newer_one_has() {
        let mut sent = 0;
        let both = readers([&[5, 6], &[1, 2, 3, 4, 5, 6]]);
        assert_eq!(all(&both, &mut sent), [1, 2, 3, 4, 5, 6]);
        assert!(both.iter().all(|reader| reader.borrow().is_empty()));
    }

    #[test]
    fn what_was_handed_out_is_not_again() {
        let mut sent = 4;
        let both = readers([&[3, 4, 5], &[4, 7]]);
        assert_eq!(step(&both, &mut sent), Next::Repeated);
        assert_eq!(all(&both, &mut sent), [5, 7]);
    }

    #[test]
    fn a_reader_that_is_left_alone_has_all_that_was_not_handed_out() {
        let mut sent = 0;
        let both = readers([&[1, 2, 3, 4], &[1, 2, 3, 4]]);
        assert_eq!(step(&both, &mut sent), Next::Taken(1));
        assert_eq!(all(&both[1..], &mut sent), [2, 3, 4]);
    }

    #[test]
    fn what_comes_between_the_looks_does_not_overtake() {
        let both = readers([&[], &[3]]);
        // Both get 2 and 3, the first reader when it has been looked at already.
        let looks = RefCell::new(0);
        let number = |reader: &RefCell<VecDeque<u64>>| {
            let number = reader.borrow().front().copied();
            if looks.replace_with(|looks| *looks + 1) == 0 {
                both[0].borrow_mut().extend([2, 3]);
            }
            number
        };
        let take =
            |reader: &RefCell<VecDeque<u64>>| reader.borrow_mut().pop_front().map(|n| (n, n));
        assert_eq!(next(&both, &mut 0, number, take), Next::Taken(2));
    }
}
