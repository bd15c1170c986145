//! Tables, as Markdown and as HTML.

use std::fmt::Write as _;

/// Tables of no more rows are printed on one page.
const SHORT: usize = 16;

/// A table.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Table {
    /// Its file's name, without ending.
    pub id: String,
    /// Above it.
    pub title: String,
    /// One for each column. The first column is text, and so is one in which a cell begins with a letter; others are
    /// numbers.
    pub head: Vec<String>,
    /// Each as long as the head.
    pub rows: Vec<Vec<String>>,
    /// Where each row's first cell leads in the page; empty where none does.
    pub links: Vec<String>,
    /// Below it: what the numbers are.
    pub note: String,
}

impl Table {
    fn is_text(&self, column: usize) -> bool {
        let is_word =
            |row: &Vec<String>| row.get(column).is_some_and(|cell| cell.starts_with(char::is_alphabetic));
        column == 0 || self.rows.iter().any(is_word)
    }

    /// As a file of its own.
    pub fn markdown(&self) -> String {
        let line = |cells: &[String]| {
            let cells = cells.iter().map(|cell| cell.replace('|', "\\|"));
            format!("| {} |\n", cells.collect::<Vec<_>>().join(" | "))
        };
        let ends = (0..self.head.len()).map(|at| if self.is_text(at) { "---" } else { "---:" });
        let rows = self.rows.iter().map(|row| line(row)).collect::<String>();
        let rule = ends.collect::<Vec<_>>().join(" | ");
        let note = if self.note.is_empty() { String::new() } else { format!("\n{}\n", self.note) };
        format!("# {}\n\n{}| {rule} |\n{rows}{note}", self.title, line(&self.head))
    }

    /// As part of the page.
    pub fn html(&self) -> String {
        let line = |tag: &str, cells: &[String], link: Option<&String>| {
            let cells = cells.iter().enumerate().map(|(at, cell)| {
                let tag = if at == 0 { "th" } else { tag };
                let class = if self.is_text(at) { "" } else { " class=\"n\"" };
                let cell = if tag == "td" && !self.is_text(at) { unbroken(cell) } else { cell.clone() };
                let cell = match link {
                    Some(link) if at == 0 => format!("<a href=\"{}\">{}</a>", escaped(link), escaped(&cell)),
                    _ => escaped(&cell),
                };
                format!("<{tag}{class}>{cell}</{tag}>")
            });
            format!("<tr>{}</tr>\n", cells.collect::<String>())
        };
        // On paper a table goes on over pages only if it has to.
        let length = if self.rows.len() <= SHORT { " short" } else { "" };
        let mut html = format!("<figure class=\"table{length}\" id=\"{}\">\n", escaped(&self.id));
        // Writing to a String does not fail.
        let _ =
            write!(html, "<figcaption>{}</figcaption>\n<div class=\"wide\"><table>\n", escaped(&self.title));
        let _ = write!(html, "<thead>{}</thead>\n<tbody>\n", line("th", &self.head, None));
        let rows = self.rows.iter().enumerate();
        rows.for_each(|(at, row)| html += &line("td", row, self.links.get(at)));
        html += "</tbody></table></div>\n";
        if !self.note.is_empty() {
            let _ = writeln!(html, "<p class=\"note\">{}</p>", escaped(&self.note));
        }
        html + "</figure>\n"
    }
}

/// Numbers of which lines end before an interval in brackets and nowhere else.
fn unbroken(cell: &str) -> String {
    cell.replace(' ', "\u{a0}").replace("\u{a0}[", " [")
}

/// Text as HTML shows it.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_name_holds_changes_no_table() {
        let table = Table {
            id: "t".to_owned(),
            title: "A <b>".to_owned(),
            head: vec!["method".to_owned(), "x|y".to_owned()],
            rows: vec![vec!["a & b".to_owned(), "−1.0 [−2.0, 0.5]†".to_owned()]],
            links: vec!["/a?b&c".to_owned()],
            note: "\"n\"".to_owned(),
        };
        let expected =
            "# A <b>\n\n| method | x\\|y |\n| --- | ---: |\n| a & b | −1.0 [−2.0, 0.5]† |\n\n\"n\"\n";
        assert_eq!(table.markdown(), expected);
        let html = table.html();
        let parsed = roxmltree::Document::parse(&html).unwrap();
        let cells = parsed.descendants().filter(|node| node.has_tag_name("td"));
        assert_eq!(cells.map(|cell| cell.text().unwrap()).collect::<Vec<_>>(), ["−1.0 [−2.0,\u{a0}0.5]†"]);
        assert!(
            html.contains("<a href=\"/a?b&amp;c\">a &amp; b</a>") && html.contains("A &lt;b&gt;"),
            "{html}"
        );
    }
}
