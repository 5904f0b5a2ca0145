//! Error (clause 6.5). The most lenient parser here: whatever the body is, the status code has
//! already said what happened.

use serde_json::Value;

use super::json;

/// Longest message passed on, bytes.
const MAX_MESSAGE: usize = 512;
/// Most details passed on.
const MAX_DETAILS: usize = 64;

#[derive(Debug, Default)]
pub(crate) struct ErrorAnswer {
    pub(crate) message: String,
    pub(crate) details: Vec<Value>,
}

pub(crate) fn error_answer(body: &[u8]) -> ErrorAnswer {
    let parsed = json::text(body, "body").ok().and_then(|text| serde_json::from_str(text).ok());
    let Some(Value::Object(mut members)) = parsed else { return ErrorAnswer::default() };
    let message = match members.remove("message") {
        Some(Value::String(message)) => printable(&message),
        _ => String::new(),
    };
    let details = match members.remove("details") {
        Some(Value::Array(mut details)) => {
            details.truncate(MAX_DETAILS);
            details
        }
        _ => Vec::new(),
    };
    ErrorAnswer { message, details }
}

/// The message goes to logs and terminals: no control characters, bounded.
fn printable(message: &str) -> String {
    let mut out = String::new();
    for c in message.chars() {
        if out.len() + c.len_utf8() > MAX_MESSAGE {
            out.push('…');
            break;
        }
        out.push(if c.is_control() { ' ' } else { c });
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn bodies_that_are_no_error_objects_give_an_empty_message() {
        for body in ["", "<html>", "[]", "\"x\"", "{\"message\":1,\"details\":{}}", "{"] {
            let answer = error_answer(body.as_bytes());
            assert_eq!((answer.message.as_str(), answer.details.len()), ("", 0), "{body}");
        }
    }

    #[test]
    fn messages_are_made_fit_for_a_terminal() {
        let answer = error_answer(br#"{"message":"no\u001b[2J key\n"}"#);
        assert_eq!(answer.message, "no [2J key ");
        let long = format!("{{\"message\":\"{}\"}}", "x".repeat(10_000));
        assert!(error_answer(long.as_bytes()).message.len() < 600);
    }

    #[test]
    fn details_are_kept() {
        let answer = error_answer(br#"{"message":"m","details":[{"key_ID":"k"}]}"#);
        assert_eq!(answer.details, [serde_json::json!({"key_ID": "k"})]);
    }

    proptest! {
        #[test]
        fn any_bytes_are_parsed_without_panic(bytes: Vec<u8>) {
            let _ = error_answer(&bytes);
        }
    }
}
