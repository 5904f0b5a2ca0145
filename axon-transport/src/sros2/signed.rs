//! The text in a signed document: S/MIME, `multipart/signed`, as `ros2 security` and OpenSSL write it.
//!
//! The signature is not verified. The certificate of the CA by which a DDS middleware would verify it lies in the same
//! folder as the document. A user who can replace the document can replace the certificate too.

/// The start of a document that may be signed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cleartext<'a> {
    /// The document itself.
    pub text: &'a str,
    /// The number of lines of the file before it.
    pub lines_before: usize,
}

/// Returns the document in a file: the first part of a signed file, or else the whole file.
///
/// # Errors
/// The file is signed in an unsupported form; the error says why.
pub fn cleartext(file: &str) -> Result<Cleartext<'_>, String> {
    if !is_mime(file) {
        return Ok(Cleartext { text: file, lines_before: 0 });
    }
    let (header, body) = split_header(file).ok_or("its MIME header has no end")?;
    let content_type = field(header, "content-type").ok_or("it has no Content-Type")?;
    let (kind, parameters) = content_type.split_once(';').unwrap_or((&content_type, ""));
    if !kind.trim().eq_ignore_ascii_case("multipart/signed") {
        let kind = kind.trim();
        return Err(format!("its Content-Type is {kind:?}; accepted: multipart/signed"));
    }
    let boundary = parameter(parameters, "boundary").ok_or("its Content-Type has no boundary")?;
    if boundary.is_empty() || boundary.len() > 70 {
        return Err("its boundary is empty, or longer than 70 characters".into());
    }
    let (part, _) = between(body, &boundary).ok_or("its first part has no beginning or no end")?;
    let (header, text) = split_header(part).ok_or("the header of its first part has no end")?;
    let is_plain = |encoding: &str| {
        ["7bit", "8bit", "binary"].iter().any(|one| encoding.eq_ignore_ascii_case(one))
    };
    if let Some(encoding) = field(header, "content-transfer-encoding").filter(|one| !is_plain(one))
    {
        return Err(format!(
            "its Content-Transfer-Encoding is {encoding:?}; accepted: 7bit, 8bit, binary"
        ));
    }
    let before = text.as_ptr() as usize - file.as_ptr() as usize;
    Ok(Cleartext { text, lines_before: file[..before].matches('\n').count() })
}

/// Returns whether a file begins with a MIME field, and not with XML.
fn is_mime(file: &str) -> bool {
    let first = file.trim_start_matches('\u{feff}').trim_start().split('\n').next();
    let name = first.and_then(|line| line.split_once(':')).map(|(name, _)| name);
    name.is_some_and(|name| {
        ["mime-version", "content-type"].iter().any(|one| name.eq_ignore_ascii_case(one))
    })
}

/// Splits a text at the empty line that ends its header. The header of a part may have no fields.
fn split_header(text: &str) -> Option<(&str, &str)> {
    let mut at = 0;
    for line in text.split_inclusive('\n') {
        if line.trim_end_matches(['\r', '\n']).is_empty() {
            return Some((&text[..at], &text[at + line.len()..]));
        }
        at += line.len();
    }
    None
}

/// Returns the value of a field, with its continuation lines.
fn field(header: &str, name: &str) -> Option<String> {
    let mut lines = header.lines();
    let of = |line: &str| {
        let (field, value) = line.split_once(':')?;
        field.trim().eq_ignore_ascii_case(name).then(|| value.trim().to_owned())
    };
    let mut value = lines.find_map(of)?;
    for line in lines.take_while(|line| line.starts_with([' ', '\t'])) {
        value.push(' ');
        value.push_str(line.trim());
    }
    Some(value)
}

/// Returns a parameter of a Content-Type, without its quotation marks.
fn parameter(parameters: &str, name: &str) -> Option<String> {
    let mut rest = parameters;
    loop {
        let (key, after) = rest.split_once('=')?;
        let after = after.trim_start();
        let (value, behind) = match after.strip_prefix('"') {
            Some(quoted) => quoted.split_once('"')?,
            None => after.split_at(after.find(';').unwrap_or(after.len())),
        };
        if key.trim().eq_ignore_ascii_case(name) {
            return Some(value.trim_end().to_owned());
        }
        rest = behind.split_once(';')?.1;
    }
}

/// Returns the text between the first two delimiter lines, and the text from the second on.
fn between<'a>(body: &'a str, boundary: &str) -> Option<(&'a str, &'a str)> {
    let mut begin = None;
    let mut at = 0;
    for line in body.split_inclusive('\n') {
        let ends = line.trim_end();
        let delimits = ends.strip_prefix("--").and_then(|rest| rest.strip_prefix(boundary));
        match (begin, delimits) {
            (None, Some("")) => begin = Some(at + line.len()),
            // The last delimiter ends with two hyphens.
            (Some(begin), Some("" | "--")) => return Some((&body[begin..at], &body[at..])),
            _ => {}
        }
        at += line.len();
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIGNED: &str = "MIME-Version: 1.0\nContent-Type: multipart/signed; protocol=\"application/x-pkcs7-signature\"; \
                          micalg=\"sha-256\"; boundary=\"----3D\"\n\nThis is an S/MIME signed message\n\n------3D\n\
                          Content-Type: text/plain\r\n\r\n<dds>\r\n</dds>\r\n\n------3D\n\
                          Content-Type: application/x-pkcs7-signature; name=\"smime.p7s\"\n\
                          Content-Transfer-Encoding: base64\n\nMII=\n\n------3D--\n\n";

    #[test]
    fn the_first_part_of_a_signed_document_is_its_text() {
        let found = cleartext(SIGNED).unwrap();
        assert_eq!(found, Cleartext { text: "<dds>\r\n</dds>\r\n\n", lines_before: 8 });
        assert_eq!(SIGNED.lines().nth(found.lines_before), Some("<dds>"));
        let all_cr = SIGNED.replace("\r\n", "\n").replace('\n', "\r\n");
        assert_eq!(cleartext(&all_cr).unwrap().text, "<dds>\r\n</dds>\r\n\r\n");
        let folded = SIGNED.replace("; boundary=\"----3D\"", ";\n\tboundary=----3D ; x=y");
        assert_eq!(cleartext(&folded).unwrap().text, found.text);
        // The form that `ros2 security` writes: Python's boundary contains the character that ends a parameter's name.
        let python =
            SIGNED.replace("----3D", "====12==").replace("\r\n", "\n").replace('\n', "\r\n");
        assert_eq!(cleartext(&python).unwrap().text, "<dds>\r\n</dds>\r\n\r\n");
        let bare = SIGNED.replace("Content-Type: text/plain\r\n", "");
        assert_eq!(cleartext(&bare).unwrap().text, found.text);
    }

    #[test]
    fn a_document_that_is_not_signed_is_its_own_text() {
        for text in ["", "<dds/>", "<?xml version=\"1.0\"?>\n<dds/>", "a:b"] {
            assert_eq!(cleartext(text).unwrap(), Cleartext { text, lines_before: 0 });
        }
    }

    #[test]
    fn another_form_of_a_signed_document_is_refused() {
        for (wrong, why) in [
            ("MIME-Version: 1.0\n".to_owned(), "no end"),
            ("MIME-Version: 1.0\n\n<dds/>".to_owned(), "no Content-Type"),
            (
                SIGNED.replace("multipart/signed", "application/x-pkcs7-mime"),
                "accepted: multipart/signed",
            ),
            (SIGNED.replace("boundary", "other"), "no boundary"),
            (SIGNED.replace("boundary=\"----3D\"", "boundary=\"\""), "boundary is empty"),
            (SIGNED.replace("boundary=\"----3D\"", "boundary=\"----3E\""), "no beginning"),
            (SIGNED[..SIGNED.rfind("------3D\n").unwrap()].to_owned(), "no end"),
            (
                SIGNED.replacen(
                    "text/plain\r\n",
                    "text/plain\nContent-Transfer-Encoding: base64\n",
                    1,
                ),
                "accepted: 7bit",
            ),
        ] {
            let said = cleartext(&wrong).unwrap_err();
            assert!(said.contains(why) && !said.contains('\n'), "{why}: {said}");
        }
    }
}
