//! Reading and writing what a person named, or what may lie in a run directory in place of a file.

use rustix::fs::OFlags;
use std::{
    fs::{self, File, OpenOptions},
    io::{self, ErrorKind, Read as _, Seek as _, SeekFrom, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::Path,
};

/// No file that a person writes is longer.
pub const TEXT_BYTES_MAX: u64 = 1 << 20;

/// Opens a regular file. A named pipe, a socket, a device or a folder in its place is an error at once: it neither waits
/// nor is it endless.
///
/// # Errors
/// When it is no regular file, or the system refuses.
pub fn open_regular(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let no_file = || io::Error::new(ErrorKind::InvalidInput, "it is no regular file");
    // A pipe that has no other end is opened at once, and then seen for what it is. Regular files know no waiting.
    let opened = options.custom_flags(OFlags::NONBLOCK.bits() as i32).open(path);
    let file = match opened {
        // A pipe to write to that has no reader, or a socket.
        Err(error) if error.raw_os_error() == Some(rustix::io::Errno::NXIO.raw_os_error()) => {
            return Err(no_file());
        }
        Err(error) if error.kind() == ErrorKind::NotFound => return Err(leads_nowhere(path).unwrap_or(error)),
        opened => opened?,
    };
    if file.metadata()?.is_file() { Ok(file) } else { Err(no_file()) }
}

/// What is wrong with a file that is not there but for a link to it. It counts as missing all the same.
fn leads_nowhere(path: &Path) -> Option<io::Error> {
    let target = fs::read_link(path).ok()?;
    let words = format!("it is a link to {}, which does not exist", target.display());
    Some(io::Error::new(ErrorKind::NotFound, words))
}

/// The bytes of a regular file.
///
/// # Errors
/// When it is no regular file, longer than `bytes_max`, or cannot be read.
pub fn read_regular(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    let file = open_regular(path, OpenOptions::new().read(true))?;
    let mut bytes = Vec::with_capacity(file.metadata()?.len().min(bytes_max) as usize);
    // What grows while it is read, or does not know its length, ends here too.
    file.take(bytes_max + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        return Err(io::Error::new(ErrorKind::FileTooLarge, format!("it has more than {bytes_max} bytes")));
    }
    Ok(bytes)
}

/// The text of a regular file, of at most [`TEXT_BYTES_MAX`] bytes.
///
/// # Errors
/// As [`read_regular`], and when it is not UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read_regular(path, TEXT_BYTES_MAX)?)
        .map_err(|_| io::Error::new(ErrorKind::InvalidData, "it is no UTF-8 text"))
}

/// The end of a regular file that others write text to, such as a log: at most so many bytes, none of those before
/// `begins_at`. What is no UTF-8 is replaced.
///
/// # Errors
/// When it is no regular file, or cannot be read.
pub fn read_tail(path: &Path, begins_at: u64, bytes_max: u64) -> io::Result<String> {
    let mut file = open_regular(path, OpenOptions::new().read(true))?;
    let from = file.metadata()?.len().saturating_sub(bytes_max).max(begins_at);
    file.seek(SeekFrom::Start(from))?;
    let mut bytes = Vec::new();
    file.take(bytes_max).read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Writes a file for its user alone, as a whole or not at all, whatever happens to the process or to the machine's power.
///
/// # Errors
/// When the system refuses, or a folder lies where it is prepared (`NAME.partial`).
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_synced(path, bytes, File::sync_all)
}

/// As [`write_whole`]; `sync` waits until what it is given is on the disk.
fn write_synced(path: &Path, bytes: &[u8], sync: impl Fn(&File) -> io::Result<()>) -> io::Result<()> {
    let partial = path.with_extension("partial");
    // Whatever a process that was killed has left there.
    let _ = fs::remove_file(&partial);
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&partial)?;
    file.write_all(bytes)?;
    // A name may reach the disk before the bytes behind it do: after a power cut an empty file would lie there.
    sync(&file)?;
    fs::rename(&partial, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // The new name. Not every file system can wait for a folder, and without it the old file, or the new one, is there.
    let _ = File::open(folder).and_then(|folder| sync(&folder));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::Mode;
    use std::cell::RefCell;

    #[test]
    fn bytes_are_on_the_disk_before_the_name_is_theirs() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        write_whole(&path, b"old").unwrap();
        let synced = RefCell::new(Vec::new());
        write_synced(&path, b"new bytes", |file| {
            let metadata = file.metadata()?;
            synced.borrow_mut().push((metadata.is_dir(), metadata.len() == 9, read_text(&path)?));
            Ok(())
        })
        .unwrap();
        let synced = synced.into_inner();
        assert_eq!(synced.len(), 2, "the file, then the folder");
        assert_eq!(synced[0], (false, true, "old".to_owned()));
        assert!(synced[1].0 && synced[1].2 == "new bytes", "{synced:?}");
        // Bytes that do not reach the disk replace nothing; a folder that cannot be synced is no error.
        let refused = || io::Error::other("the disk is gone");
        assert!(write_synced(&path, b"newer", |_| Err(refused())).is_err());
        assert_eq!(read_text(&path).unwrap(), "new bytes");
        let folders_cannot =
            |file: &File| if file.metadata()?.is_dir() { Err(refused()) } else { file.sync_all() };
        write_synced(&path, b"newest", folders_cannot).unwrap();
        assert_eq!(read_text(&path).unwrap(), "newest");
    }

    #[test]
    fn of_a_log_only_the_end_is_read() {
        let log = tempfile::NamedTempFile::new().unwrap();
        fs::write(log.path(), b"before\nlast \xff words\n").unwrap();
        let tail = |begins_at, bytes_max| read_tail(log.path(), begins_at, bytes_max).unwrap();
        assert_eq!(tail(7, 100), "last \u{fffd} words\n");
        assert_eq!(tail(0, 6), "words\n");
        assert_eq!(tail(100, 6), "", "it was cut off meanwhile");
        assert!(read_tail(&log.path().with_extension("gone"), 0, 6).is_err());
    }

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
        // Nor is anything written into a pipe.
        let mut options = OpenOptions::new();
        let written = open_regular(&pipe, options.append(true).create(true)).unwrap_err();
        assert_eq!(written.to_string(), "it is no regular file");
        fs::rename(&pipe, folder.path().join("file.partial")).unwrap();
        write_whole(&path, b"new").unwrap();
        assert_eq!(read_text(&path).unwrap(), "new");
        assert!(!folder.path().join("file.partial").exists());
        assert!(message(&folder.path().join("nothing"), 100).contains("No such file"));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("gone/file", &link).unwrap();
        assert_eq!(message(&link, 100), "it is a link to gone/file, which does not exist");
        assert_eq!(read_text(&link).unwrap_err().kind(), ErrorKind::NotFound);
        fs::write(&path, [0xff]).unwrap();
        assert_eq!(read_text(&path).unwrap_err().to_string(), "it is no UTF-8 text");
    }
}
