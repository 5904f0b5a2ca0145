//! Call stacks, taken quickly and named later.

/// The innermost frames of a call stack.
pub(crate) struct Trace {
    frames: [usize; Self::FRAMES],
}

/// The crates that stand between a caller and the allocator, or that carry bytes for their caller.
const CARRIERS: [&str; 8] =
    ["alloc", "backtrace", "bytes", "canary", "core", "hashbrown", "std", "zeroize"];

impl Trace {
    const FRAMES: usize = 40;

    pub(crate) fn here() -> Self {
        let mut frames = [0; Self::FRAMES];
        let mut at = 0;
        backtrace::trace(|frame| {
            frames[at] = frame.ip() as usize;
            at += 1;
            at < Self::FRAMES
        });
        Self { frames }
    }

    /// Returns the functions, innermost first, without hashes.
    pub(crate) fn names(&self) -> Vec<String> {
        self.functions().into_iter().map(|function| function.name).collect()
    }

    /// Returns the innermost function that is not a mere carrier.
    pub(crate) fn site(&self) -> String {
        let functions = self.functions();
        let site = functions.iter().find(|f| !CARRIERS.contains(&f.krate.as_str()));
        site.map_or_else(String::new, |function| match &function.krate {
            named if function.name.contains(&format!("{named}::")) => function.name.clone(),
            krate => format!("{krate}: {}", function.name),
        })
    }

    fn functions(&self) -> Vec<Function> {
        let mut functions = Vec::new();
        for frame in self.frames.iter().take_while(|frame| **frame != 0) {
            backtrace::resolve(*frame as *mut _, |symbol| {
                let name = symbol.name().map(|name| format!("{name:#}")).unwrap_or_default();
                let file = symbol.filename().map(|file| file.display().to_string());
                let krate = match file {
                    Some(file) => crate_of_file(&file),
                    None => crate_of_name(&name),
                };
                functions.push(Function { name, krate });
            });
        }
        functions
    }
}

struct Function {
    name: String,
    krate: String,
}

/// Functions with line numbers, which may have short names: `etsi_qkd014` of
/// `etsi-qkd014/src/key.rs`, `bytes` of `.../bytes-1.2.3/src/lib.rs`, and `std` of all of Rust's.
fn crate_of_file(file: &str) -> String {
    if file.starts_with("/rustc/") || file.contains("/rustlib/") {
        return "std".to_owned();
    }
    if file.contains("tests/canary/") {
        return "canary".to_owned();
    }
    let folder = file.rsplit_once("/src/").map_or("", |(before, _)| before);
    let folder = folder.rsplit('/').next().unwrap_or(folder);
    let name = match folder.rsplit_once('-') {
        Some((name, version)) if version.contains('.') => name,
        _ => folder,
    };
    name.replace('-', "_")
}

/// Functions without: `rustls` of `<rustls::vecbuf::ChunkVecBuffer>::append`.
fn crate_of_name(name: &str) -> String {
    let path = name.trim_start_matches(['<', '&', '(', '[']);
    let path = path.strip_prefix("dyn ").unwrap_or(path);
    match path.split_once("::") {
        Some((krate, _)) if !krate.starts_with("__") => krate.to_owned(),
        // C's and the compiler's.
        _ => "core".to_owned(),
    }
}
