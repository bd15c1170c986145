//! The page: all sections in one file that needs nothing else.

use crate::{Figure, Table, table::escaped};
use std::fmt::Write as _;

/// A part of the report.
#[derive(Clone, Debug, Default)]
pub struct Section {
    /// For links.
    pub id: String,
    /// Above it.
    pub title: String,
    /// Paragraphs.
    pub text: Vec<String>,
    /// Pictures.
    pub figures: Vec<Figure>,
    /// Numbers.
    pub tables: Vec<Table>,
    /// Where else to look: address and words.
    pub links: Vec<(String, String)>,
    /// A picture of its own: address and words. No report has one, since it needs nothing else.
    pub image: Option<(String, String)>,
}

impl Section {
    /// An empty one.
    pub fn new(id: &str, title: &str) -> Self {
        Self { id: id.to_owned(), title: title.to_owned(), ..Self::default() }
    }

    /// Whether there is nothing in it.
    pub fn is_empty(&self) -> bool {
        self.text.is_empty() && self.figures.is_empty() && self.tables.is_empty() && self.links.is_empty()
    }
}

/// How a page looks.
pub const CSS: &str = include_str!("page.css");

/// What tells the page of a report, which may be written over, from pages that other programs made.
pub const GENERATOR: &str = "<meta name=\"generator\" content=\"rit report\">";

/// The page of these sections: with its looks in it, as a report has it, or where they lie.
pub fn page(title: &str, sections: &[Section], stylesheet: Option<&str>) -> String {
    let title = escaped(title);
    let mut html = String::from(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light\">\n",
    );
    let looks = match stylesheet {
        Some(address) => format!("<link rel=\"stylesheet\" href=\"{}\">", escaped(address)),
        None => {
            html += GENERATOR;
            html += "\n";
            format!("<style>\n{CSS}</style>")
        }
    };
    // Writing to a String does not fail.
    let _ = write!(html, "<title>{title}</title>\n{looks}\n</head>\n<body>\n");
    let _ = write!(html, "<header><h1>{title}</h1>\n<nav aria-label=\"Sections\">");
    for section in sections {
        let _ = write!(html, "<a href=\"#{}\">{}</a>", escaped(&section.id), escaped(&section.title));
    }
    html += "</nav></header>\n<main>\n";
    for section in sections {
        let (id, title) = (escaped(&section.id), escaped(&section.title));
        let _ = writeln!(html, "<section id=\"{id}\">\n<h2>{title}</h2>");
        for text in &section.text {
            let _ = writeln!(html, "<p>{}</p>", escaped(text));
        }
        section.figures.iter().for_each(|figure| html += &figure_html(figure));
        section.tables.iter().for_each(|table| html += &table.html());
        if let Some((address, words)) = &section.image {
            let _ = writeln!(html, "<p><img src=\"{}\" alt=\"{}\"></p>", escaped(address), escaped(words));
        }
        if !section.links.is_empty() {
            let link = |(address, words): &(String, String)| {
                format!("<li><a href=\"{}\">{}</a></li>", escaped(address), escaped(words))
            };
            let _ = writeln!(html, "<ul>{}</ul>", section.links.iter().map(link).collect::<String>());
        }
        html += "</section>\n";
    }
    html += "</main>\n</body>\n</html>\n";
    html
}

fn figure_html(figure: &Figure) -> String {
    let (id, title) = (escaped(&figure.id), escaped(&figure.title));
    // Within a page a picture is as wide as there is room, and has its name for those who cannot see it.
    let svg = figure.svg.find("<svg").map_or("", |at| &figure.svg[at + 4..]);
    format!(
        "<figure class=\"chart\" id=\"{id}\">\n<figcaption>{title}</figcaption>\n<div class=\"wide\"><svg role=\"img\" \
         aria-label=\"{title}\"{svg}</div>\n<p class=\"note\">{}</p>\n</figure>\n",
        escaped(&figure.caption)
    )
}
