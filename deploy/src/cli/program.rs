//! The command line in the words of the program that runs: a program of one's own has another name than `rit`.

use super::Cli;
use clap::{Arg, Command, CommandFactory as _, FromArgMatches as _, builder::StyledStr};
use rit_config::{in_program_words, program_name};
use std::ffi::OsString;

/// Reads a command line, the program first.
///
/// # Errors
/// When it is none, or asks for help.
pub fn parse(arguments: impl IntoIterator<Item = OsString>) -> Result<Cli, clap::Error> {
    let matches = command().try_get_matches_from(arguments)?;
    Cli::from_arg_matches(&matches).map_err(|error| error.format(&mut command()))
}

/// What can be typed.
pub fn command() -> Command {
    let command = Cli::command();
    if command.get_name() == program_name() { command } else { renamed(command).name(program_name()) }
}

fn renamed(mut command: Command) -> Command {
    let words = |text: Option<&StyledStr>| text.map(in_words);
    let about = [command.get_about(), command.get_long_about()].map(words);
    let after = [command.get_after_help(), command.get_after_long_help()].map(words);
    let ([about, long_about], [after, after_long]) = (about, after);
    for (text, set) in [
        (about, Command::about as fn(Command, String) -> Command),
        (long_about, Command::long_about),
        (after, Command::after_help),
        (after_long, Command::after_long_help),
    ] {
        if let Some(text) = text {
            command = set(command, text);
        }
    }
    command.mut_args(renamed_argument).mut_subcommands(renamed)
}

fn renamed_argument(argument: Arg) -> Arg {
    let help = argument.get_help().map(in_words);
    let long_help = argument.get_long_help().map(in_words);
    let argument = match help {
        Some(help) => argument.help(help),
        None => argument,
    };
    match long_help {
        Some(long_help) => argument.long_help(long_help),
        None => argument,
    }
}

fn in_words(text: &StyledStr) -> String {
    in_program_words(&text.to_string()).into_owned()
}
