//! A file that grows record by record, and outlives a disk that is full for a while.

use crate::replay_log::remedy;
use std::{fs::File, io, os::unix::fs::FileExt as _, path::PathBuf};

/// A file and what could not be written to it yet.
#[derive(Debug)]
pub struct AppendFile {
    path: PathBuf,
    file: File,
    len: u64,
    /// Records that the disk refused, oldest first: they go before the next one.
    waiting: Vec<u8>,
}

impl AppendFile {
    /// Goes on after the first `len` bytes of a file opened for writing; what comes after them is cut off.
    ///
    /// # Errors
    /// When it cannot be cut.
    pub fn new(path: PathBuf, file: File, len: u64) -> io::Result<Self> {
        let len = len.min(file.metadata()?.len());
        file.set_len(len)?;
        Ok(Self { path, file, len, waiting: Vec::new() })
    }

    /// Bytes of the file: whole records only.
    pub fn written(&self) -> u64 {
        self.len
    }

    /// Writes a record at once, so that followers of the file see it whole. What the disk refuses is kept and
    /// written with the next one: training does not end for want of its record.
    pub fn append(&mut self, record: &[u8]) {
        let was_refused = !self.waiting.is_empty();
        self.waiting.extend_from_slice(record);
        match self.flush() {
            Ok(()) if was_refused => tracing::info!(path = %self.path.display(), "can be written again"),
            Ok(()) => {}
            Err(error) if !was_refused => {
                let remedy = remedy(&error);
                tracing::error!(path = %self.path.display(), "not written for now: {error}{remedy}");
            }
            Err(_) => {}
        }
    }

    /// Writes what waits. Refused, the file stays as it was.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn flush(&mut self) -> io::Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        // At its place, so that what an earlier attempt has left there is written over.
        if let Err(error) = self.file.write_all_at(&self.waiting, self.len) {
            // A disk that refuses this too keeps part of a record after `len`, where readers do not look.
            let _ = self.file.set_len(self.len);
            return Err(error);
        }
        self.len += self.waiting.len() as u64;
        self.waiting.clear();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{
        fs,
        io::{Seek as _, SeekFrom, Write as _},
    };

    #[test]
    fn what_a_refused_write_has_left_is_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("records");
        let file = File::create(&path).unwrap();
        let mut records = AppendFile::new(path.clone(), file, 0).unwrap();
        records.append(b"first\n");
        // Part of a record, by a write that the disk refused halfway, as it did the cut after it.
        records.file.seek(SeekFrom::Start(records.len)).unwrap();
        records.file.write_all(b"sec").unwrap();
        records.append(b"second\n");
        assert_eq!(fs::read_to_string(&path).unwrap(), "first\nsecond\n");
        assert_eq!(records.written(), 13);
    }

    #[test]
    fn it_continues_after_what_it_is_told_is_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("records");
        for (len, expected) in [(6, "first\nnext\n"), (99, "first\ntorn next\n")] {
            fs::write(&path, "first\ntorn ").unwrap();
            let file = File::options().write(true).open(&path).unwrap();
            let mut records = AppendFile::new(path.clone(), file, len).unwrap();
            records.append(b"next\n");
            assert_eq!(fs::read_to_string(&path).unwrap(), expected);
        }
    }
}
