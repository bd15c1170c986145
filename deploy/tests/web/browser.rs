//! A real browser, driven through chromedriver, and what a test asks of a page in it.

use crate::{
    DEADLINE,
    common::{RunFolder, kill},
};
use fantoccini::{Client, ClientBuilder, Locator, elements::Element};
use hyper_util::client::legacy::connect::HttpConnector;
use rustix::process::Signal;
use serde_json::{Value, json};
use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    process::{Child, Command, Stdio},
    time::Instant,
};

/// A script's expression: what is not where it should be on the page.
pub(crate) const OUT_OF_PLACE: &str = "(() => {
    const found = document.documentElement.scrollWidth > innerWidth ? ['the page is wider than the screen'] : [];
    for (const card of document.querySelectorAll('.card, .tiles, header')) {
        const { left, right } = card.getBoundingClientRect();
        for (const part of card.querySelectorAll('*')) {
            const box = part.getBoundingClientRect();
            const scrolls = part.closest('pre') !== null;
            if (box.width && !scrolls && (box.right > right + 1 || box.left < left - 1)) found.push(part.outerHTML);
        }
    }
    const words = document.querySelectorAll('.tiles dt, .tiles dd, header p, header button, th, td, .legend li, h2');
    const texts = [...words].filter((part) => part.getClientRects().length && part.textContent.trim());
    const boxes = texts.map((part) => {
        const range = document.createRange();
        range.selectNodeContents(part);
        return range.getBoundingClientRect();
    });
    boxes.forEach((a, at) => boxes.slice(at + 1).forEach((b, after) => {
        const [one, other] = [texts[at], texts[at + 1 + after]];
        const apart = a.right <= b.left + 1 || b.right <= a.left + 1 || a.bottom <= b.top + 1 || b.bottom <= a.top + 1;
        if (!apart && !one.contains(other)) found.push(`${one.textContent} lies on ${other.textContent}`);
    }));
    return found;
})()";

/// A browser, and the process that drives it.
pub(crate) struct Browser {
    driver: Child,
    driver_host: String,
    session: String,
    pub(crate) client: Client,
}

impl Browser {
    /// `None`, and a word, where none is installed.
    pub(crate) async fn start(folder: &RunFolder) -> Option<Self> {
        let driver = Command::new("chromedriver").arg("--port=0").stdout(Stdio::piped()).spawn();
        let Ok(mut driver) = driver else {
            println!("skipped: there is no chromedriver; apt-get install chromium chromium-driver");
            return None;
        };
        let mut lines = BufReader::new(driver.stdout.take().unwrap()).lines();
        let port = lines.find_map(|line| {
            let line = line.unwrap();
            line.split_once("started successfully on port ")
                .map(|(_, port)| port.trim_end_matches('.').to_owned())
        });
        // Else it stops at a full pipe.
        std::thread::spawn(move || lines.for_each(drop));
        let profile = format!("--user-data-dir={}", folder.path().join("browser").display());
        let arguments = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--window-size=1366,768",
            &profile,
        ];
        let mut builder = ClientBuilder::new(HttpConnector::new());
        let options = json!({ "goog:chromeOptions": { "args": arguments } });
        builder.capabilities(options.as_object().unwrap().clone());
        let driver_host = format!("127.0.0.1:{}", port.unwrap());
        let client = builder.connect(&format!("http://{driver_host}")).await.unwrap();
        let session = client.session_id().await.unwrap().unwrap();
        Some(Self { driver, driver_host, session, client })
    }

    pub(crate) async fn wait_for(&self, css: &str) {
        self.find(Locator::Css(css)).await;
    }

    pub(crate) async fn find(&self, wanted: Locator<'_>) -> Element {
        match self.client.wait().at_most(DEADLINE).for_element(wanted).await {
            Ok(element) => element,
            Err(error) => panic!("{wanted:?}: {error} in {}", self.client.source().await.unwrap()),
        }
    }

    pub(crate) async fn wait_for_state(&self, state: &str) {
        let path = format!("//*[@id='state'][text()='{state}']");
        self.find(Locator::XPath(&path)).await;
    }

    pub(crate) async fn click(&self, id: &str) {
        let enabled = format!("#{id}:enabled");
        self.find(Locator::Css(&enabled)).await.click().await.unwrap();
    }

    /// Until a script says so.
    pub(crate) async fn until(&self, script: &str) {
        let begun = Instant::now();
        while self.js(script).await != true {
            if begun.elapsed() > DEADLINE {
                panic!("out of place: {}", self.js(&format!("return [innerWidth, {OUT_OF_PLACE}]")).await);
            }
        }
    }

    pub(crate) async fn js(&self, script: &str) -> Value {
        self.client.execute(script, vec![]).await.unwrap()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The browser outlives the driver unless its session is ended first, whatever became of the test.
        if let Ok(mut stream) = TcpStream::connect(&self.driver_host) {
            let (session, host) = (&self.session, &self.driver_host);
            let _ = write!(
                stream,
                "DELETE /session/{session} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
            );
            // The answer comes when the browser has gone; the driver leaves the connection open.
            let _ = stream.set_read_timeout(Some(DEADLINE));
            let _ = stream.read(&mut [0; 512]);
        }
        kill(self.driver.id(), Signal::TERM);
        let _ = self.driver.wait();
    }
}
