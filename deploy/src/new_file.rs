//! Files that commands make for people: whole or not at all, and over nothing unless that is asked for.

use crate::failure::Failure;
use std::{
    fs::Permissions,
    io::{self, Write as _},
    os::unix::fs::PermissionsExt as _,
    path::Path,
};

/// Refuses a file that is there already, unless it may be written over. Asked before the work of making its content.
///
/// # Errors
/// When it is there.
pub fn check(path: &Path, force: bool) -> Result<(), Failure> {
    // A dangling link is there too: moving a file onto it would replace it.
    if path.symlink_metadata().is_ok() && !force { Err(occupied(path)) } else { Ok(()) }
}

/// Writes the file beside its place and moves it there.
///
/// # Errors
/// When it is there and may not be written over, or cannot be written.
pub fn write(path: &Path, bytes: &[u8], force: bool) -> Result<(), Failure> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let wrong = |error: io::Error| {
        // The file beside its place has a name that says nothing to a person.
        let reason = match error.kind() {
            io::ErrorKind::AlreadyExists => return occupied(path),
            io::ErrorKind::NotFound => format!("there is no folder {}", folder.display()),
            _ if error.raw_os_error().is_some() => error.to_string(),
            kind => kind.to_string(),
        };
        Failure::input_message(format!("--out {}: {reason}", path.display()))
    };
    let readable = Permissions::from_mode(0o666); // less what the umask takes
    let mut partial = tempfile::Builder::new().permissions(readable).tempfile_in(folder).map_err(wrong)?;
    partial.write_all(bytes).map_err(wrong)?;
    // Not there when looked for, but meanwhile it may be.
    let moved = if force { partial.persist(path) } else { partial.persist_noclobber(path) };
    moved.map(drop).map_err(|error| wrong(error.error))
}

fn occupied(path: &Path) -> Failure {
    Failure::input_message(format!("{} is there already; --force writes over it", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_wrong_is_said_of_the_file_that_was_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("none/curves.svg");
        let said = write(&path, b"", false).unwrap_err().to_string();
        let none = folder.path().join("none");
        assert_eq!(said, format!("--out {}: there is no folder {}", path.display(), none.display()));
        let path = folder.path().join("curves.svg");
        write(&path, b"one", false).unwrap();
        assert!(write(&path, b"two", false).unwrap_err().to_string().contains("--force writes over it"));
        write(&path, b"three", true).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"three");
    }
}
