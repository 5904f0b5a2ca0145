//! Searches the stack below the caller for secrets that a piece of work left there. For tests.

use std::{fs::File, hint::black_box, os::unix::fs::FileExt, ptr, thread};

/// Deeper than the calls that the search itself makes.
const ROOM: usize = 32 << 10;
/// Number of bytes below the caller that are searched.
const SEARCHED: usize = 512 << 10;
/// Number of bytes of a secret that count as a find.
const PIECE: usize = 8;

/// Returns the numbers of the `secrets` of which `work` left a piece on its stack. Keeps the result of `work` until the
/// search is done.
pub(crate) fn left_on_the_stack<T>(
    work: impl FnOnce() -> T + Send,
    secrets: impl FnOnce(&T) -> Vec<Vec<u8>> + Send,
) -> Vec<usize> {
    let search = move || {
        let memory = File::open("/proc/self/mem").unwrap();
        let mut stack = vec![0; SEARCHED];
        let result = below(work);
        let here = black_box(ptr::from_ref(&stack)).addr();
        memory.read_exact_at(&mut stack, (here - SEARCHED) as u64).unwrap();
        let is_left = |secret: &[u8]| {
            secret.chunks_exact(PIECE).any(|piece| stack.windows(PIECE).any(|at| at == piece))
        };
        let secrets = secrets(&result);
        (0..secrets.len()).filter(|number| is_left(&secrets[*number])).collect()
    };
    thread::scope(|scope| {
        let thread = thread::Builder::new().stack_size(2 << 20).spawn_scoped(scope, search);
        thread.unwrap().join().unwrap()
    })
}

/// Runs `work` with room above its stack.
#[inline(never)]
fn below<T>(work: impl FnOnce() -> T) -> T {
    let mut room = [0_u8; ROOM];
    black_box(room.as_mut_slice());
    let result = work();
    black_box(room.as_mut_slice());
    result
}

#[test]
fn a_secret_left_on_the_stack_is_found() {
    /// Computes the secret from a seed, so that it is stored nowhere.
    fn secret() -> [u8; 32] {
        std::array::from_fn(|at| black_box(at as u8).wrapping_mul(151) ^ 0x5e)
    }
    #[inline(never)]
    fn leave() {
        black_box(&mut secret());
    }
    assert_eq!(left_on_the_stack(leave, |()| vec![secret().to_vec(), vec![0xa7; 32]]), [0]);
}
