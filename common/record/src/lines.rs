//! A file of lines, read from its beginning.

use crate::{Header, Line, Progress, RecordError, header::FORMAT_VERSION, is_header};
use std::{
    fs::{File, OpenOptions},
    io::{BufRead as _, BufReader, Read as _, Seek as _, SeekFrom},
    path::{Path, PathBuf},
};

/// No line is longer: whatever is has no line's end and is no metrics file.
const LINE_BYTES_MAX: u64 = 64 << 20;

/// The lines of a `metrics.jsonl`, in order. A torn last one is the end; others that cannot be read are left out and
/// counted.
#[derive(Debug)]
pub struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    buffer: Vec<u8>,
    header: Option<Header>,
    broken: usize,
}

impl Lines {
    /// Begins to read.
    ///
    /// # Errors
    /// When the file is not there, is no regular file, or is of another format.
    pub fn open(path: &Path) -> Result<Self, RecordError> {
        let file =
            rit_config::open_regular(path, OpenOptions::new().read(true)).map_err(RecordError::io(path))?;
        let mut lines = Self {
            path: path.to_owned(),
            reader: BufReader::new(file),
            buffer: Vec::new(),
            header: None,
            broken: 0,
        };
        let begins = lines.reader.fill_buf().map_err(RecordError::io(path))?;
        if is_header(begins) && lines.read_one()? == Found::Whole {
            lines.take_header()?;
        }
        Ok(lines)
    }

    /// The first line, where the file has one.
    pub fn header(&self) -> Option<&Header> {
        self.header.as_ref()
    }

    /// Lines that could not be read so far.
    pub fn broken(&self) -> usize {
        self.broken
    }

    /// The next line that can be read; none at the end.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn next_line(&mut self) -> Result<Option<Line>, RecordError> {
        loop {
            let read = self.read_one()?;
            match (read, Line::parse(&self.buffer)) {
                (Found::Whole | Found::Last, Ok(line)) => return Ok(Some(line)),
                (Found::Whole, Err(_)) => self.broken += 1,
                // Torn, or nothing: the end of the file.
                (Found::Last | Found::Nothing, _) => return Ok(None),
            }
        }
    }

    fn take_header(&mut self) -> Result<(), RecordError> {
        match serde_json::from_slice::<Header>(&self.buffer) {
            Ok(Header { format_version, .. }) if format_version != FORMAT_VERSION => {
                let (path, found, known) = (self.path.clone(), format_version, FORMAT_VERSION);
                return Err(RecordError::Format { path, found, known });
            }
            Ok(header) => self.header = Some(header),
            Err(_) => self.broken += 1,
        }
        Ok(())
    }

    /// Reads one line into the buffer, without its end.
    fn read_one(&mut self) -> Result<Found, RecordError> {
        self.buffer.clear();
        let mut line = (&mut self.reader).take(LINE_BYTES_MAX + 1);
        let read = line.read_until(b'\n', &mut self.buffer).map_err(RecordError::io(&self.path))?;
        if read as u64 > LINE_BYTES_MAX {
            let why = format!("a line is longer than {LINE_BYTES_MAX} bytes");
            return Err(RecordError::Other { path: self.path.clone(), what: "metrics file", why });
        }
        Ok(match self.buffer.pop_if(|&mut last| last == b'\n') {
            Some(_) => Found::Whole,
            None if self.buffer.is_empty() => Found::Nothing,
            None => Found::Last,
        })
    }
}

/// How far training had come in the last line of a file that says so; nothing where none does. Reads the end alone.
pub fn last_progress(path: &Path) -> Option<Progress> {
    const TAIL: u64 = 1 << 18;
    let mut file = rit_config::open_regular(path, OpenOptions::new().read(true)).ok()?;
    let len = file.metadata().ok()?.len();
    file.seek(SeekFrom::Start(len.saturating_sub(TAIL))).ok()?;
    let mut tail = Vec::new();
    file.take(TAIL).read_to_end(&mut tail).ok()?;
    tail.rsplit(|&byte| byte == b'\n').find_map(|line| Line::parse(line).ok()?.progress())
}

/// What was read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Found {
    /// A line with its end.
    Whole,
    /// The last line, which has no end: torn, or written so by a person.
    Last,
    /// There is nothing more.
    Nothing,
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const HEADER: &str = r#"{"kind":"run","format_version":1,"run_id":"ab"}"#;

    fn line(env_steps: u64) -> String {
        format!(r#"{{"kind":"evaluation","env_steps":{env_steps},"episodes":1,"updates":1,"tasks":{{}}}}"#)
    }

    /// Environment steps of what is read, and how many lines are not.
    fn read(text: &[u8]) -> (Vec<u64>, usize) {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), text).unwrap();
        let mut lines = Lines::open(file.path()).unwrap();
        let mut steps = Vec::new();
        while let Some(line) = lines.next_line().unwrap() {
            steps.push(line.progress().map_or(u64::MAX, |progress| progress.env_steps));
        }
        (steps, lines.broken())
    }

    #[test]
    fn a_torn_last_line_is_the_end_wherever_it_is_torn() {
        let text = format!("{HEADER}\n{}\n{}\n", line(1), line(2));
        let second = text.find(&line(2)).unwrap();
        for len in 0..=text.len() {
            let expected: &[u64] = match len {
                // Whole but for its end.
                _ if len >= text.len() - 1 => &[1, 2],
                _ if len >= second - 1 => &[1],
                _ => &[],
            };
            assert_eq!(read(&text.as_bytes()[..len]), (expected.to_vec(), 0), "{len}");
        }
    }

    #[test]
    fn other_lines_that_cannot_be_read_are_left_out_and_counted() {
        let text = format!("{}\n\0\0\n{{\"kind\":\"evaluation\"}}\n\n{}\n", line(1), line(2));
        assert_eq!(read(text.as_bytes()), (vec![1, 2], 3));
        assert_eq!(read(b"\xff\xfe\n"), (vec![], 1));
    }

    #[test]
    fn the_last_line_is_found_from_the_end() {
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(last_progress(file.path()), None);
        let many: String = (0..10_000).map(|env_steps| line(env_steps) + "\n").collect();
        fs::write(file.path(), format!("{HEADER}\n{many}{{\"kind\":\"tr")).unwrap();
        assert_eq!(last_progress(file.path()).unwrap().env_steps, 9999);
        assert_eq!(last_progress(Path::new("/nowhere")), None);
    }

    #[test]
    fn another_format_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), HEADER.replace(":1,", ":9,") + "\n").unwrap();
        let refused = Lines::open(file.path()).unwrap_err().to_string();
        assert!(
            refused
                .ends_with("has format version 9, this build reads 1; read it with the build that wrote it")
        );
    }
}
