//! What a process that ended said last: why it ended, if its log tells.

use crate::traceback;
use rit_config::read_tail;
use std::path::Path;

/// Bytes of a log, from its end, that are looked through.
const TAIL: u64 = 64 << 10;

/// Why the process that writes this log ended, as far as it said. `begins_at` is the log's length when it started: what
/// lies before is of others.
pub fn last_words(log: &Path, begins_at: u64) -> String {
    match read_tail(log, begins_at, TAIL) {
        Ok(text) => in_text(&text),
        Err(error) => format!("its log cannot be read: {error}"),
    }
}

/// The traceback of an environment that stands before the process's last error, without its marks.
pub fn last_traceback(log: &Path, begins_at: u64) -> Option<String> {
    let text = read_tail(log, begins_at, TAIL).ok()?;
    let lines: Vec<&str> = text.lines().collect();
    let at = lines.iter().rposition(|line| line.starts_with("error: "))?;
    let lines: Vec<&str> = traceback::before(&lines[..at]).into_iter().map(traceback::unmarked).collect();
    (!lines.is_empty()).then(|| lines.join("\n"))
}

/// The last error; a panic's message; else the last line that is no report of success.
fn in_text(text: &str) -> String {
    let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    let last = |is: &dyn Fn(&str) -> bool| lines.iter().rposition(|line| is(line));
    if let Some(at) = last(&|line| line.starts_with("error: ")) {
        return lines[at].trim_start_matches("error: ").to_owned();
    }
    if let Some(at) = last(&|line| level(line) == Some("ERROR")) {
        return message(lines[at]);
    }
    if let Some(at) = last(&|line| line.contains("' panicked at ") || line.contains(") panicked at ")) {
        let place = lines[at].trim_end_matches(':');
        return lines.get(at + 1).map_or_else(|| place.to_owned(), |words| format!("{place}: {words}"));
    }
    match last(&|line| !matches!(level(line), Some("INFO" | "DEBUG" | "TRACE"))) {
        Some(at) => message(lines[at]),
        None => "its log gives no reason".to_owned(),
    }
}

/// The level of a line of a log, of either format; `None` of any other line.
fn level(line: &str) -> Option<&'static str> {
    let levels = ["ERROR", "WARN", "INFO", "DEBUG", "TRACE"];
    levels.into_iter().find(|level| {
        line.split_whitespace().nth(1) == Some(level) || line.contains(&format!("\"level\":\"{level}\""))
    })
}

/// What a line of a log says, without time and level.
fn message(line: &str) -> String {
    if let Ok(object) = serde_json::from_str::<serde_json::Value>(line) {
        let fields = object.get("fields").and_then(serde_json::Value::as_object);
        let said = |key: &str| fields?.get(key)?.as_str();
        let words: Vec<_> = ["message", "error"].into_iter().filter_map(said).collect();
        if !words.is_empty() {
            return words.join(": ");
        }
    }
    match level(line) {
        Some(level) => line.split_once(level).map_or(line, |(_, rest)| rest.trim()).to_owned(),
        None => line.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    const INFO: &str =
        "2026-01-01T00:00:00Z  INFO process{name=\"learner\" pid=7}: the run goes on at step 5";

    #[test]
    fn the_reason_is_an_error_and_never_a_report_of_success() {
        for (text, words) in [
            (format!("{INFO}\nerror: no space left\n{INFO}\n\n"), "no space left"),
            (format!("2026-01-01T00:00:00Z ERROR process{{}}: disk is full\n{INFO}\n"), "process{}: disk is full"),
            (
                format!("{INFO}\n\nthread 'train' (9) panicked at src/a.rs:1:2:\nindex out of bounds\nnote: run with\n"),
                "thread 'train' (9) panicked at src/a.rs:1:2: index out of bounds",
            ),
            (
                "{\"timestamp\":\"t\",\"level\":\"ERROR\",\"fields\":{\"message\":\"no\",\"error\":\"full\"}}\n\
                 {\"timestamp\":\"t\",\"level\":\"INFO\",\"fields\":{\"message\":\"yes\"}}\n"
                    .to_owned(),
                "no: full",
            ),
            (format!("Killed by the kernel\n{INFO}\n"), "Killed by the kernel"),
            (format!("{INFO}\n{INFO}\n"), "its log gives no reason"),
            (String::new(), "its log gives no reason"),
        ] {
            assert_eq!(in_text(&text), words, "{text}");
        }
    }

    #[test]
    fn only_the_last_process_is_heard_and_not_its_whole_log() {
        let mut log = tempfile::NamedTempFile::new().unwrap();
        let before = "error: of a former life\n";
        log.write_all(before.as_bytes()).unwrap();
        let begins_at = before.len() as u64;
        assert_eq!(last_words(log.path(), 0), "of a former life");
        assert_eq!(last_words(log.path(), begins_at), "its log gives no reason");
        // Not UTF-8, and longer than what is looked through.
        log.write_all(&vec![0xff; 200_000]).unwrap();
        log.write_all(b"\nerror: of this one\n").unwrap();
        assert_eq!(last_words(log.path(), begins_at), "of this one");
        log.write_all(b"| File a.py\n| E: x\nerror: E: x (a.py)\n").unwrap();
        assert_eq!(last_words(log.path(), begins_at), "E: x (a.py)");
        assert_eq!(last_traceback(log.path(), begins_at).as_deref(), Some("File a.py\nE: x"));
        log.write_all(b"error: another\n").unwrap();
        assert_eq!(last_traceback(log.path(), begins_at), None);
        assert!(last_words(Path::new("/nowhere"), 0).starts_with("its log cannot be read: "));
    }
}
