//! What commands print, and what becomes of it where it cannot be written.
//!
//! The standard library's print macros panic there; nothing here does. A closed pipe means that the reader has had
//! enough, and is no failure; a full disk is one.

use crate::failure::Failure;
use rit_config::in_program_words;
use std::io::{self, ErrorKind, Write as _};

/// Whether what is printed still has a reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reader {
    /// As far as one can tell.
    There,
    /// It has closed its end of the pipe.
    Gone,
}

/// Prints a command's result on standard output, as it is.
///
/// # Errors
/// When it cannot be written, as on a full disk. A reader that has gone is no error.
pub fn print(text: &str) -> Result<Reader, Failure> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Ok(()) => Ok(Reader::There),
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(Reader::Gone),
        Err(error) => Err(Failure::runtime_message(format!("cannot write to standard output: {error}"))),
    }
}

/// Says something beside a command's result, as a line on standard error, in the words of the program that runs.
///
/// # Errors
/// When it cannot be written. Mostly that is to be ignored: there is no other place to say it.
pub fn say(line: &str) -> io::Result<()> {
    // In one piece, so that lines of several processes on one terminal do not mix.
    io::stderr().lock().write_all(format!("{}\n", in_program_words(line)).as_bytes())
}
