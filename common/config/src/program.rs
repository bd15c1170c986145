//! What the program is called: `rit`, or as the file of a program of one's own, which is `rit` with its task sets.
//!
//! Messages everywhere are written for `rit`; where they are said, [`in_program_words`] has them name the program that runs.

use std::{borrow::Cow, sync::OnceLock};

/// Its name if no other was given.
const RIT: &str = "rit";

static NAME: OnceLock<String> = OnceLock::new();

/// The program's name, as a person types it.
pub fn program_name() -> &'static str {
    NAME.get().map_or(RIT, String::as_str)
}

/// Names the program, once and before anything is said; what is no name changes nothing.
pub fn set_program_name(name: &str) {
    if !name.is_empty() && !name.contains(char::is_control) {
        // A second name is not asked for.
        let _ = NAME.set(name.to_owned());
    }
}

/// A message with commands in backticks, such as `` `rit train` ``, in the words of the program that runs.
pub fn in_program_words(text: &str) -> Cow<'_, str> {
    called(text, program_name())
}

fn called<'a>(text: &'a str, name: &str) -> Cow<'a, str> {
    const COMMAND: &str = "`rit ";
    if name == RIT || !text.contains(COMMAND) {
        return Cow::Borrowed(text);
    }
    Cow::Owned(text.replace(COMMAND, &format!("`{name} ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_in_messages_are_those_of_the_program_that_runs() {
        let text = "no learner runs for runs/rit-1; `rit train --resume x` goes on, `rit ctl` asks; rit-vdn is an algorithm";
        assert_eq!(called(text, "rit"), text);
        assert_eq!(
            called(text, "corridor"),
            "no learner runs for runs/rit-1; `corridor train --resume x` goes on, `corridor ctl` asks; rit-vdn is an \
             algorithm"
        );
        assert_eq!(program_name(), "rit", "no other name was given");
    }
}
