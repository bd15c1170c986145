//! Tracebacks of environments, as people are shown them: on lines of their own before the error, so that who reads a process's
//! log, the supervisor among them, finds them there.

use crate::output;
use rit_env::EnvironmentError;

/// What each line begins with.
const MARK: &str = "| ";

/// As many lines are shown; of more, those in the middle are left out.
const LINES_MAX: usize = 60;

/// Of these, from the beginning.
const FIRST: usize = 10;

/// Characters of a line that are shown.
const LINE_CHARS_MAX: usize = 300;

/// Shows where in an environment's code an error was raised, if it was.
pub fn say(error: &anyhow::Error) {
    let raised = error.chain().find_map(|cause| cause.downcast_ref::<EnvironmentError>());
    if let Some(traceback) = raised.and_then(|error| error.traceback.as_ref()) {
        // The error says in a line what this says in many, should there be no reader.
        let _ = output::say(&marked(traceback));
    }
}

/// The lines of a traceback, marked, bounded and fit for a terminal. Environments wrote them: nothing there is trusted.
pub fn marked(traceback: &str) -> String {
    let lines: Vec<&str> = traceback.trim_end().lines().collect();
    let line = |line: &&str| {
        let shown: String = line.chars().take(LINE_CHARS_MAX).map(printable).collect();
        format!("{MARK}{shown}{}", if shown.len() < line.len() { "…" } else { "" })
    };
    let all: Vec<String> = if lines.len() <= LINES_MAX {
        lines.iter().map(line).collect()
    } else {
        let (first, last) = (&lines[..FIRST], &lines[lines.len() - (LINES_MAX - FIRST)..]);
        let left_out = format!("{MARK}… {} lines …", lines.len() - LINES_MAX);
        first.iter().map(line).chain([left_out]).chain(last.iter().map(line)).collect()
    };
    all.join("\n")
}

/// The marked lines right before a line of a log; empty where there are none.
pub fn before<'a>(lines: &[&'a str]) -> Vec<&'a str> {
    let begin = lines.iter().rposition(|line| !line.starts_with(MARK.trim_end())).map_or(0, |at| at + 1);
    lines[begin..].to_vec()
}

/// Without the mark.
pub fn unmarked(line: &str) -> &str {
    line.strip_prefix(MARK).or_else(|| line.strip_prefix(MARK.trim_end())).unwrap_or(line)
}

/// Terminals obey control characters, and some characters of format turn text around.
fn printable(c: char) -> char {
    let turns = matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    if c.is_control() && c != '\t' || turns { '\u{fffd}' } else { c }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_marked_bounded_and_do_nothing_to_a_terminal() {
        assert_eq!(
            marked("Traceback:\n  File \"a.py\"\u{1b}[2J\nE: x\n"),
            "| Traceback:\n|   File \"a.py\"\u{fffd}[2J\n| E: x"
        );
        let long: Vec<String> = (0..100).map(|at| format!("line {at}")).collect();
        let shown = marked(&long.join("\n"));
        let shown: Vec<&str> = shown.lines().collect();
        assert_eq!(shown.len(), LINES_MAX + 1);
        assert_eq!((shown[9], shown[10], shown[11]), ("| line 9", "| … 40 lines …", "| line 50"));
        assert_eq!(marked(&"x".repeat(1000)), format!("| {}…", "x".repeat(LINE_CHARS_MAX)));
    }

    #[test]
    fn a_log_s_lines_before_its_error_are_found_again() {
        let text = format!("noise\n{}", marked("one\n\ntwo"));
        let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
        let found: Vec<&str> = before(&lines).into_iter().map(unmarked).collect();
        assert_eq!(found, ["one", "", "two"]);
        assert!(before(&["noise"]).is_empty());
    }

    #[test]
    fn an_error_s_traceback_is_found_below_what_wraps_it() {
        use rit_env::{FailureKind, rollout::LostEpisode};
        let error = EnvironmentError {
            traceback: Some("here".into()),
            ..EnvironmentError::new(FailureKind::Raised, "E: x")
        };
        let lost = anyhow::Error::new(LostEpisode { number: 1, task: "two".into(), error });
        let found = lost.chain().find_map(|cause| cause.downcast_ref::<EnvironmentError>());
        assert_eq!(found.and_then(|error| error.traceback.as_deref()), Some("here"));
    }
}
