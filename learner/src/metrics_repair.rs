//! What a learner finds of `metrics.jsonl` when it goes on: lines that are whole are kept, and what is not is said.

use crate::damaged;
use rit_config::open_regular;
use rit_record::{Header, OtherFile, is_header};
use serde::{Deserialize, de::IgnoredAny};
use std::{
    fs::{self, OpenOptions},
    io::{self, BufRead as _, BufReader, Seek as _, SeekFrom, Write as _},
    ops::Range,
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
};

/// Why a learner cannot go on with the file.
#[derive(Debug, thiserror::Error)]
pub enum MetricsError {
    /// Another run's, or another build's.
    #[error(transparent)]
    OtherFile(#[from] OtherFile),
    /// The system refused.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// Where a checkpoint says that the file ends.
#[derive(Clone, Copy, Debug)]
pub struct End {
    /// The last line's environment steps, at most.
    pub env_steps: u64,
    /// Its length in bytes.
    pub len: u64,
}

/// What a line must have.
#[derive(Deserialize)]
struct Any {
    env_steps: u64,
    /// Of an evaluation that was not due: it was made at a run's end, after the last checkpoint.
    occasion: Option<IgnoredAny>,
}

impl Any {
    /// Whether a learner that goes on from a checkpoint at so many steps will come to this line again.
    fn is_after(&self, env_steps: u64) -> bool {
        self.env_steps > env_steps || self.occasion.is_some()
    }
}

/// What lies in the file up to an end.
#[derive(Debug, Default)]
struct Lines {
    /// Where whole lines lie.
    whole: Vec<Range<u64>>,
    /// Whether the first of them is the header.
    has_header: bool,
    /// Lines among them that cannot be read.
    broken: usize,
    /// Environment steps of the last whole one.
    last: u64,
}

impl Lines {
    fn len(&self) -> u64 {
        self.whole.iter().map(|range| range.end - range.start).sum()
    }

    /// Reads lines until one is beyond the end: that, and what follows it, was written by a learner that died.
    fn read(path: &Path, header: &Header, until_env_steps: u64) -> Result<Self, MetricsError> {
        let mut reader = BufReader::new(open_regular(path, OpenOptions::new().read(true))?);
        let (mut lines, mut line, mut at) = (Self::default(), Vec::new(), 0);
        // Broken lines after the last whole one are no hole among them.
        let mut broken_since = 0;
        loop {
            line.clear();
            let read = reader.read_until(b'\n', &mut line)? as u64;
            if read == 0 {
                return Ok(lines);
            }
            let range = at..at + read;
            at = range.end;
            if range.start == 0 && is_header(&line) && line.ends_with(b"\n") {
                // One that cannot be read is written anew, as one that is missing.
                if let Ok(found) = serde_json::from_slice(&line) {
                    header.check(&found)?;
                    lines.has_header = true;
                    lines.whole.push(range);
                }
                continue;
            }
            match serde_json::from_slice::<Any>(&line) {
                Ok(any) if any.is_after(until_env_steps) => return Ok(lines),
                Ok(any) if line.ends_with(b"\n") => {
                    (lines.broken, lines.last) = (lines.broken + broken_since, any.env_steps);
                    broken_since = 0;
                    match lines.whole.last_mut() {
                        Some(last) if last.end == range.start => last.end = range.end,
                        _ => lines.whole.push(range),
                    }
                }
                _ => broken_since += 1,
            }
        }
    }

    /// What was done about those that are not whole.
    fn words(&self) -> String {
        let header = "its first line, which says whose it is, is written anew";
        let are = if self.broken == 1 { "is" } else { "are" };
        let broken = format!("{} of its lines cannot be read and {are} left out", self.broken);
        match (self.has_header, self.broken) {
            (true, _) => broken,
            (false, 0) => header.to_owned(),
            (false, _) => format!("{header}, {broken}"),
        }
    }

    /// Whether nothing lies before or between them.
    fn are_the_beginning(&self) -> bool {
        self.whole.len() <= 1 && self.whole.first().is_none_or(|range| range.start == 0)
    }
}

/// Cuts the file after its last whole line up to the end, and takes lines out that cannot be read. Returns how long
/// it is then, and what a person should know of it.
///
/// # Errors
/// When it is of another run or build, or the system refuses.
pub fn repair(path: &Path, header: &Header, end: End) -> Result<(u64, Option<String>), MetricsError> {
    if !path.exists() {
        return Ok((
            0,
            Some(format!("{} is gone: a new one begins at {} steps", path.display(), end.env_steps)),
        ));
    }
    let mut lines = Lines::read(path, header, end.env_steps)?;
    // The header and the first line after it are one range.
    lines.whole.dedup_by(|next, last| {
        let joined = last.end == next.start;
        if joined {
            last.end = next.end;
        }
        joined
    });
    let (len, last) = (lines.len(), lines.last);
    let path_shown = path.display();
    let is_headless = len > 0 && !lines.has_header;
    if is_headless || !lines.are_the_beginning() {
        let first = if is_headless { header.line()? } else { Vec::new() };
        let damaged = rewrite(path, &first, &lines.whole)?;
        let warning = format!("{path_shown}: {}; as it was, it lies in {}", lines.words(), damaged.display());
        return Ok((first.len() as u64 + len, Some(warning)));
    }
    let file = open_regular(path, OpenOptions::new().write(true))?;
    file.set_len(len)?;
    let warning = (len != end.len).then(|| {
        format!(
            "{path_shown} ends at {last} steps where the checkpoint at {} steps remembers more: lines are missing, it \
             goes on after its last whole one",
            end.env_steps
        )
    });
    Ok((len, warning))
}

/// Writes the file anew, of a first line and these ranges; keeps the old one beside it. Returns where.
fn rewrite(path: &Path, first: &[u8], ranges: &[Range<u64>]) -> io::Result<PathBuf> {
    let damaged = damaged::free_place(path).ok_or_else(|| {
        io::Error::other(format!(
            "{} damaged ones of this name lie beside it already; move them away",
            damaged::KEPT_MAX
        ))
    })?;
    let partial = path.with_extension("jsonl.partial");
    let mut options = OpenOptions::new();
    let mut to = open_regular(&partial, options.write(true).create(true).truncate(true).mode(0o600))?;
    let mut from = open_regular(path, OpenOptions::new().read(true))?;
    to.write_all(first)?;
    for range in ranges {
        from.seek(SeekFrom::Start(range.start))?;
        io::copy(&mut io::Read::take(&mut from, range.end - range.start), &mut to)?;
    }
    to.flush()?;
    to.sync_all()?;
    fs::hard_link(path, &damaged)?;
    fs::rename(&partial, path)?;
    Ok(damaged)
}

#[cfg(test)]
mod tests {
    use super::*;

    const RUN: &str = r#"{"kind":"run","format_version":1,"run_id":"ab"}"#;

    fn line(env_steps: u64) -> String {
        format!("{{\"kind\":\"evaluation\",\"env_steps\":{env_steps},\"td_loss\":null}}\n")
    }

    /// Header and lines at 0, 10 and 20 steps, whose checkpoint was written after the last; then one at 30.
    fn whole() -> String {
        format!("{RUN}\n{}{}{}{}", line(0), line(10), line(20), line(30))
    }

    fn end() -> End {
        End { env_steps: 20, len: (whole().len() - line(30).len()) as u64 }
    }

    /// What is left of a file, and what is said.
    fn repaired(text: &str) -> (String, Option<String>) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        fs::write(&path, text).unwrap();
        let (len, warning) = repair(&path, &Header::of("ab".into(), None), end()).unwrap();
        let left = fs::read_to_string(&path).unwrap();
        assert_eq!(left.len() as u64, len);
        if let Some(damaged) = warning.as_ref().filter(|warning| warning.contains("damaged")) {
            assert_eq!(
                fs::read_to_string(folder.path().join("metrics.jsonl.damaged")).unwrap(),
                text,
                "{damaged}"
            );
        }
        (left, warning)
    }

    #[test]
    fn what_a_dead_learner_wrote_last_goes_without_a_warning() {
        let kept = &whole()[..end().len as usize];
        assert_eq!(repaired(&whole()), (kept.to_owned(), None));
        assert_eq!(
            repaired(&whole()[..whole().len() - 5]),
            (kept.to_owned(), None),
            "torn after the checkpoint"
        );
        assert_eq!(repaired(kept), (kept.to_owned(), None));
    }

    #[test]
    fn what_was_measured_at_a_former_end_goes_without_a_warning() {
        let kept = &whole()[..end().len as usize];
        let at_the_end = line(20).replace("\"td_loss\"", "\"occasion\":\"final\",\"td_loss\"");
        let best = at_the_end.replace(":20", ":10").replace("final", "best");
        assert_eq!(repaired(&format!("{kept}{at_the_end}{best}")), (kept.to_owned(), None));
    }

    #[test]
    fn what_is_missing_is_said_and_the_last_whole_line_is_the_end() {
        let (all, kept) = (whole(), whole()[..end().len as usize].to_owned());
        let two = &all[..all.find(&line(20)).unwrap()];
        for torn in [two.to_owned(), kept[..kept.len() - 1].to_owned(), format!("{two}{{\"kind")] {
            let (left, warning) = repaired(&torn);
            assert_eq!(left, two);
            assert!(
                warning.unwrap().contains("ends at 10 steps where the checkpoint at 20 steps remembers more")
            );
        }
        let (left, warning) = repaired("");
        assert!(left.is_empty() && warning.unwrap().contains("ends at 0 steps"));
        let gone = tempfile::tempdir().unwrap();
        let (len, warning) =
            repair(&gone.path().join("metrics.jsonl"), &Header::of("ab".into(), None), end()).unwrap();
        assert!(len == 0 && warning.unwrap().ends_with("is gone: a new one begins at 20 steps"));
    }

    #[test]
    fn a_torn_line_in_the_middle_is_taken_out_and_the_rest_stays() {
        // Torn by a full disk, and glued to the next.
        let glued = whole().replace(&line(10), &line(10)[..20]);
        let (left, warning) = repaired(&glued);
        assert_eq!(left, format!("{RUN}\n{}", line(0)), "the glued one is both");
        assert!(warning.unwrap().contains("lines are missing"), "nothing whole comes after it");
        let zeros = whole().replace(&line(10), "\0\0\0\n");
        let (left, warning) = repaired(&zeros);
        assert_eq!(left, format!("{RUN}\n{}{}", line(0), line(20)));
        assert!(warning.unwrap().contains("1 of its lines cannot be read and is left out"));
    }

    #[test]
    fn a_first_line_that_is_torn_or_gone_is_written_anew() {
        let kept = whole()[..end().len as usize].to_owned();
        let header = String::from_utf8(Header::of("ab".into(), None).line().unwrap()).unwrap();
        let lines = &kept[RUN.len() + 1..];
        // Gone, torn, with a byte that is no text in it, and no longer to be known for a header.
        for (first, broken) in [
            (String::new(), ""),
            (format!("{}\n", &RUN[..30]), ""),
            (format!("{}\n", RUN.replace("ab", "a\0")), ""),
            (format!("\0\0{}\n", &RUN[2..]), ", 1 of its lines cannot be read and is left out"),
        ] {
            let (left, warning) = repaired(&format!("{first}{lines}"));
            assert_eq!(left, header.clone() + lines, "{first:?}");
            let words = format!("its first line, which says whose it is, is written anew{broken}; as it was");
            assert!(warning.as_ref().unwrap().contains(&words), "{warning:?}");
        }
    }

    #[test]
    fn another_runs_file_is_refused_and_stays_as_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        for (text, message) in [
            (whole().replace("\"ab\"", "\"cd\""), "it is of another run (cd); move it away"),
            (whole().replace("\"format_version\":1", "\"format_version\":9"), "it has format version 9"),
        ] {
            fs::write(&path, &text).unwrap();
            let error = repair(&path, &Header::of("ab".into(), None), end()).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
    }
}
