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

/// Writes the file that this option names beside its place and moves it there.
///
/// # Errors
/// When it is there and may not be written over, or cannot be written.
pub fn write(option: &str, path: &Path, bytes: &[u8], force: bool) -> Result<(), Failure> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let wrong = |error: io::Error| match error.kind() {
        io::ErrorKind::AlreadyExists => occupied(path),
        io::ErrorKind::NotFound => Failure::input_message(format!(
            "{option} {}: there is no folder {}",
            path.display(),
            folder.display()
        )),
        _ => failure(option, path, &error),
    };
    let readable = Permissions::from_mode(0o666); // less what the umask takes
    let mut partial = tempfile::Builder::new().permissions(readable).tempfile_in(folder).map_err(wrong)?;
    partial.write_all(bytes).map_err(wrong)?;
    // Not there when looked for, but meanwhile it may be.
    let moved = if force { partial.persist(path) } else { partial.persist_noclobber(path) };
    moved.map(drop).map_err(|error| wrong(error.error))
}

/// Why nothing can be made at the path of this option: another path helps, or, where the disk is full or broken, it does not.
pub fn failure(option: &str, path: &Path, error: &io::Error) -> Failure {
    use io::ErrorKind;
    // The file beside its place has a name that says nothing to a person.
    let reason = if error.raw_os_error().is_some() { error.to_string() } else { error.kind().to_string() };
    let message = format!("{option} {}: {reason}", path.display());
    match error.kind() {
        ErrorKind::NotFound
        | ErrorKind::PermissionDenied
        | ErrorKind::AlreadyExists
        | ErrorKind::NotADirectory
        | ErrorKind::IsADirectory
        | ErrorKind::ReadOnlyFilesystem
        | ErrorKind::InvalidFilename
        | ErrorKind::InvalidInput => Failure::input_message(message),
        _ => Failure::runtime_message(message),
    }
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
        let said = write("--replay", &path, b"", false).unwrap_err().to_string();
        let none = folder.path().join("none");
        assert_eq!(said, format!("--replay {}: there is no folder {}", path.display(), none.display()));
        let path = folder.path().join("curves.svg");
        write("--out", &path, b"one", false).unwrap();
        let said = write("--out", &path, b"two", false).unwrap_err().to_string();
        assert!(said.contains("--force writes over it"), "{said}");
        write("--out", &path, b"three", true).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"three");
        let inside = write("--out", &path.join("inside"), b"", false).unwrap_err();
        assert!(matches!(inside, Failure::Input(_)), "a file is no folder: {inside}");
    }

    #[test]
    fn a_full_or_broken_disk_is_a_failure_and_no_wrong_input() {
        use io::ErrorKind;
        let failure = |kind: ErrorKind| failure("--slurm", Path::new("job.sbatch"), &kind.into());
        for kind in [ErrorKind::StorageFull, ErrorKind::QuotaExceeded, ErrorKind::Other] {
            let failure = failure(kind);
            assert!(matches!(failure, Failure::Runtime(_)), "{failure}");
            assert_eq!(failure.to_string(), format!("--slurm job.sbatch: {kind}"));
        }
        for kind in [ErrorKind::PermissionDenied, ErrorKind::IsADirectory, ErrorKind::ReadOnlyFilesystem] {
            assert!(matches!(failure(kind), Failure::Input(_)), "{kind}");
        }
    }
}
