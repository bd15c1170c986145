//! A file that grows record by record, and outlives a disk that is full for a while.

use crate::replay_log::remedy;
use std::{
    fs::File,
    io::{self, Seek as _, SeekFrom, Write as _},
    path::PathBuf,
};

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
    pub fn new(path: PathBuf, mut file: File, len: u64) -> io::Result<Self> {
        file.set_len(len.min(file.metadata()?.len()))?;
        let len = file.seek(SeekFrom::End(0))?;
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
        if let Err(error) = self.file.write_all(&self.waiting) {
            self.file.set_len(self.len)?;
            self.file.seek(SeekFrom::Start(self.len))?;
            return Err(error);
        }
        self.len += self.waiting.len() as u64;
        self.waiting.clear();
        Ok(())
    }
}
