//! Finds out which quirks a KME needs.

use etsi_qkd014::{Error, Quirks};

/// The result of a call, and the names of the quirks that it needs.
pub(super) struct Tolerated<T> {
    pub(super) value: T,
    pub(super) needed: Vec<&'static str>,
}

/// Makes a call strictly, then with all quirks, then without each quirk that it does not need. The
/// error is that of the strict call.
///
/// Sizes in bytes are tried last, because that quirk also changes the request.
pub(super) async fn least<T>(
    mut call: impl AsyncFnMut(Quirks) -> Result<T, Error>,
) -> Result<Tolerated<T>, Error> {
    let strict = match call(Quirks::STRICT).await {
        Ok(value) => return Ok(Tolerated { value, needed: Vec::new() }),
        Err(error) => error,
    };
    // Quirks help only if an answer came and was not accepted, or if the client would not ask for a
    // key_ID that this KME has given.
    let answered = matches!(
        strict.cause(),
        Error::Malformed { .. }
            | Error::Check { .. }
            | Error::BadRequest { .. }
            | Error::Request { .. }
    );
    if !answered {
        return Err(strict);
    }
    let all = Quirks::NAMES.iter().map(|(name, _)| *name).collect();
    for mut names in [but_bytes(), all] {
        let Ok(mut value) = call(sum(&names)).await else { continue };
        for name in names.clone() {
            let fewer: Vec<_> = names.iter().copied().filter(|other| *other != name).collect();
            if let Ok(same) = call(sum(&fewer)).await {
                (names, value) = (fewer, same);
            }
        }
        return Ok(Tolerated { value, needed: names });
    }
    Err(strict)
}

/// Returns all names except `size-in-bytes`.
fn but_bytes() -> Vec<&'static str> {
    let names = Quirks::NAMES.iter().map(|(name, _)| *name);
    names.filter(|name| *name != "size-in-bytes").collect()
}

/// Returns all quirks that only accept more than the specification allows.
pub(super) fn lenient() -> Quirks {
    sum(&but_bytes())
}

/// Returns the quirks with these names.
fn sum(names: &[&'static str]) -> Quirks {
    let chosen = Quirks::NAMES.iter().filter(|(name, _)| names.contains(name));
    chosen.fold(Quirks::STRICT, |all, (_, quirk)| all | *quirk)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn malformed() -> Error {
        Error::Malformed { what: "x".into(), reason: "y".into() }
    }

    #[tokio::test]
    async fn the_least_set_is_found() {
        for needed in [vec![], vec!["extra-members"], vec!["any-key-id", "null-members"]] {
            let wanted = sum(&needed);
            let call = async |quirks: Quirks| {
                if quirks.contains(wanted) { Ok(quirks) } else { Err(malformed()) }
            };
            let found = least(call).await.unwrap();
            assert_eq!(found.needed, needed);
            assert_eq!(found.value, wanted);
        }
        let found =
            least(
                async |quirks: Quirks| {
                    if quirks.contains(Quirks::SIZE_IN_BYTES) { Ok(()) } else { Err(malformed()) }
                },
            );
        assert_eq!(found.await.unwrap().needed, ["size-in-bytes"]);
    }

    #[tokio::test]
    async fn errors_beyond_quirks_are_not_retried() {
        let mut calls = 0;
        let error = least(async |_| {
            calls += 1;
            Err::<(), _>(Error::Interrupted { reason: "cut".into() })
        });
        assert!(matches!(error.await, Err(Error::Interrupted { .. })));
        assert_eq!(calls, 1);
        assert!(least(async |_| Err::<(), _>(malformed())).await.is_err());
    }
}
