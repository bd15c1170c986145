//! What was typed and is no command line, in one line of words.

use crate::{cli, failure::Failure, output};
use clap::{
    Error,
    error::{ContextKind, ContextValue, ErrorKind},
};
use rit_config::program_name;
use std::{
    io::{self, IsTerminal as _},
    process::ExitCode,
};

/// Prints the help that was asked for, or says what is wrong; returns the exit code.
pub fn report(error: &Error) -> ExitCode {
    if error.use_stderr() {
        let words = words(error, std::env::args().skip(1));
        return Failure::input_message(words).report();
    }
    let text = error.render();
    let text = if io::stdout().is_terminal() { text.ansi().to_string() } else { text.to_string() };
    output::print(&text).map_or_else(|failure| failure.report(), |_| ExitCode::SUCCESS)
}

/// What is wrong with these arguments.
fn words(error: &Error, mut arguments: impl Iterator<Item = String>) -> String {
    let names = commands();
    let command = arguments.find(|argument| names.contains(argument));
    let program = program_name();
    let help = command.as_ref().map_or_else(String::new, |name| format!(" {name}"));
    let help = format!("{program}{help} --help");
    let context = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.clone()),
        Some(ContextValue::Strings(texts)) => Some(texts.join(", ")),
        _ => None,
    };
    let argument = context(ContextKind::InvalidArg).unwrap_or_default();
    match error.kind() {
        ErrorKind::UnknownArgument => {
            let suggested = context(ContextKind::SuggestedArg);
            let suggested = suggested.map(|option| format!("did you mean {option}?"));
            let (keys, are_called_so) = keys_meant(&argument, command.as_deref());
            let settings: Vec<_> = keys.iter().map(|key| format!("--set {key}=VALUE")).collect();
            // The very name of a key is no slip of another option's.
            let advice = if !keys.is_empty() && (are_called_so || suggested.is_none()) {
                Some(format!("a key is set with {}", settings.join(" or ")))
            } else {
                suggested
            };
            format!("unknown option {argument}; {}", advice.unwrap_or_else(|| format!("`{help}` lists them")))
        }
        ErrorKind::ValueValidation => {
            let value = context(ContextKind::InvalidValue).unwrap_or_default();
            let why = std::error::Error::source(error).map_or_else(String::new, |why| format!(": {why}"));
            format!("{} {value:?}{why}", option(&argument))
        }
        ErrorKind::InvalidValue => {
            let value = context(ContextKind::InvalidValue).unwrap_or_default();
            let option = option(&argument);
            match context(ContextKind::ValidValue) {
                _ if value.is_empty() => format!("{option} needs a value; `{help}` says which"),
                Some(choices) => format!("{option} {value:?} is not one of: {choices}"),
                None => format!("{option} {value:?} is not accepted; `{help}` lists what is"),
            }
        }
        ErrorKind::InvalidSubcommand => {
            let command = context(ContextKind::InvalidSubcommand).unwrap_or_default();
            let suggested = context(ContextKind::SuggestedSubcommand);
            let advice = suggested.map(|name| format!("did you mean {name}?"));
            format!(
                "unknown command {command:?}; {}",
                advice.unwrap_or_else(|| format!("`{help}` lists them"))
            )
        }
        ErrorKind::MissingRequiredArgument => format!("{argument} is missing; `{help}` explains it"),
        ErrorKind::MissingSubcommand | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            format!("which command? `{help}` lists them")
        }
        ErrorKind::ArgumentConflict => {
            let other = context(ContextKind::PriorArg).unwrap_or_default();
            format!("{argument} and {other} do not go together")
        }
        _ => first_paragraph(&error.render().to_string()),
    }
}

/// Names of the commands.
fn commands() -> Vec<String> {
    cli::command().get_subcommands().map(|command| command.get_name().to_owned()).collect()
}

/// An option without what stands for its value: `--steps <N>` is `--steps`.
fn option(argument: &str) -> &str {
    argument.split(' ').next().unwrap_or(argument)
}

/// The keys of the configuration that were meant, perhaps, where the command takes any; and whether they are called so.
fn keys_meant(argument: &str, command: Option<&str>) -> (Vec<String>, bool) {
    let root = cli::command();
    let takes_keys = command
        .and_then(|name| root.find_subcommand(name))
        .is_some_and(|command| command.get_arguments().any(|option| option.get_id() == "settings"));
    if !takes_keys {
        return (Vec::new(), false);
    }
    let name = option(argument).trim_start_matches('-');
    let keys = rit_config::keys_like(name);
    let is_called_so = |key: &String| key.rsplit('.').next() == Some(&name.replace('-', "_"));
    let are_called_so = keys.iter().all(is_called_so);
    (keys, are_called_so)
}

/// What clap says before it comes to usage and tips, in one line.
fn first_paragraph(text: &str) -> String {
    let lines = text.lines().map(str::trim).take_while(|line| !line.is_empty());
    let words = lines.collect::<Vec<_>>().join(" ");
    words.trim_start_matches("error: ").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Cli;
    use clap::Parser as _;

    fn refused(arguments: &[&str]) -> String {
        let error = Cli::try_parse_from([&["rit"], arguments].concat()).unwrap_err();
        words(&error, arguments.iter().map(|&argument| argument.to_owned()))
    }

    #[test]
    fn every_mistake_is_one_line_that_names_it_and_the_remedy() {
        for (arguments, message) in [
            (
                &["train", "x", "--lr", "0.1"][..],
                "unknown option --lr; a key is set with --set algorithm.lr=VALUE",
            ),
            (
                &["train", "x", "--batch-size=5"],
                "unknown option --batch-size; a key is set with --set algorithm.batch_size=VALUE",
            ),
            (
                &["train", "x", "--listen", "y"],
                "unknown option --listen; a key is set with --set learner.listen=VALUE or --set web.listen=VALUE",
            ),
            (&["plot", "x", "--lr"], "unknown option --lr; `rit plot --help` lists them"),
            (&["train", "x", "--step", "5"], "unknown option --step; did you mean --steps?"),
            (&["train", "x", "--zzz"], "unknown option --zzz; `rit train --help` lists them"),
            (
                &["train", "x", "--steps", "lots"],
                "--steps \"lots\": write a whole number, such as 1000000, 1_000_000, 1e6, 100k or 2M",
            ),
            (&["train", "x", "--steps", "32.0"], "--steps \"32.0\": write a whole number: 32"),
            (
                &["train", "x", "--seed", "18446744073709551615"],
                "--seed \"18446744073709551615\": it is out of range 0..=9223372036854775807",
            ),
            (&["train", "x", "--actors=-1"], "--actors \"-1\": write a whole number of at least 0"),
            (&["train", "x", "--seed", "-1"], "--seed \"-1\": write a whole number of at least 0"),
            (&["render", "--episodes", "21"], "--episodes \"21\": it is out of range 1..=20"),
            (&["plot", "x", "--out", "y", "--line", "nan"], "--line \"nan\": write a number, such as -12.5"),
            (&["train", "x", "--log-format", "xml"], "--log-format \"xml\" is not one of: human, json"),
            (&["train", "x", "--steps"], "--steps needs a value; `rit train --help` says which"),
            (&["trian"], "unknown command \"trian\"; did you mean train?"),
            (&["plot", "x"], "--out <FILE> is missing; `rit plot --help` explains it"),
            (&["train"], "<EXPERIMENT> is missing; `rit train --help` explains it"),
            (&["train", "--resume", "x", "--seed", "5"], "--resume <DIR> and --seed <N> do not go together"),
            (&[], "which command? `rit --help` lists them"),
        ] {
            assert_eq!(refused(arguments), message, "{arguments:?}");
        }
    }

    #[test]
    fn the_name_of_any_key_is_answered_with_how_it_is_set() {
        let command = cli::command();
        let train = command.find_subcommand("train").unwrap();
        let options: Vec<_> = train.get_arguments().filter_map(|option| option.get_long()).collect();
        let mut asked = 0;
        for key in rit_config::all_keys() {
            let name = key.rsplit('.').next().unwrap();
            for name in [name.to_owned(), name.replace('_', "-")] {
                if options.contains(&name.as_str()) {
                    continue;
                }
                asked += 1;
                let message = refused(&["train", "matrix-game", &format!("--{name}"), "0.5"]);
                assert!(
                    message.starts_with(&format!("unknown option --{name}; a key is set with --set "))
                        && message.contains(&format!("--set {key}=VALUE")),
                    "{message}"
                );
            }
        }
        assert!(asked > 100, "{asked}");
    }

    #[test]
    fn the_command_line_is_one_that_clap_understands() {
        cli::command().debug_assert();
    }
}
