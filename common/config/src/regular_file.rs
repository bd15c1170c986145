//! Reading what a person named, or what may lie in a run directory in place of a file.

use rustix::fs::{Mode, OFlags};
use std::{
    fs::File,
    io::{self, Read as _},
    path::Path,
};

/// No file that a person writes is longer.
pub const TEXT_BYTES_MAX: u64 = 1 << 20;

/// The bytes of a regular file. A named pipe, a device or a folder is no error that waits, and never endless.
///
/// # Errors
/// When it is no regular file, longer than `bytes_max`, or cannot be read.
pub fn read_regular(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    // A pipe that nobody writes to is opened at once, and then seen for what it is.
    let file = rustix::fs::open(path, OFlags::RDONLY | OFlags::NONBLOCK | OFlags::CLOEXEC, Mode::empty())?;
    let file = File::from(file);
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is no regular file"));
    }
    let mut bytes = Vec::with_capacity(metadata.len().min(bytes_max) as usize);
    // What grows while it is read, or does not know its length, ends here too.
    file.take(bytes_max + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        return Err(io::Error::new(
            io::ErrorKind::FileTooLarge,
            format!("it has more than {bytes_max} bytes"),
        ));
    }
    Ok(bytes)
}

/// The text of a regular file, of at most [`TEXT_BYTES_MAX`] bytes.
///
/// # Errors
/// As [`read_regular`], and when it is not UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read_regular(path, TEXT_BYTES_MAX)?)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is no UTF-8 text"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn only_regular_files_of_a_known_length_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        fs::write(&path, "text").unwrap();
        assert_eq!(read_text(&path).unwrap(), "text");
        assert_eq!(read_regular(&path, 4).unwrap(), b"text");
        let message = |path: &Path, bytes_max| read_regular(path, bytes_max).unwrap_err().to_string();
        assert_eq!(message(&path, 3), "it has more than 3 bytes");
        let pipe = folder.path().join("pipe");
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, Mode::RWXU).unwrap();
        for other in [&*pipe, Path::new("/dev/zero"), folder.path()] {
            assert_eq!(message(other, 100), "it is no regular file", "{}", other.display());
        }
        assert!(message(&folder.path().join("nothing"), 100).contains("No such file"));
        fs::write(&path, [0xff]).unwrap();
        assert_eq!(read_text(&path).unwrap_err().to_string(), "it is no UTF-8 text");
    }
}
