//! `reconstruct --watch`: the report page of a running reconstruction, on the loopback address.

use super::report::standing;
use conefield_core::{Error, Result};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tracing::{debug, info};

/// Seconds after which the page asks for a newer one.
const RENEWED: u64 = 5;

/// Time limit of a request, and maximum size of one in bytes.
const PATIENCE: Duration = Duration::from_secs(2);
const LONGEST: usize = 8 << 10;

/// Serves the page of the run in `folder` on `port` (any free port for 0) until the process ends.
///
/// Only this machine can connect, and only the page is served, one request at a time.
pub fn serve(folder: &Path, port: u16) -> Result<()> {
    let failed = |e| Error::io(PathBuf::from(format!("127.0.0.1:{port}")), e);
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(failed)?;
    let port = listener.local_addr().map_err(failed)?.port();
    info!("the run is shown at http://127.0.0.1:{port}/");
    let folder = folder.to_path_buf();
    std::thread::Builder::new()
        .name("watch".into())
        .spawn(move || {
            for stream in listener.incoming().flatten() {
                if let Err(e) = answer(stream, port, &folder) {
                    debug!("watch: {e}");
                }
            }
        })
        .map_err(failed)?;
    Ok(())
}

fn answer(mut stream: TcpStream, port: u16, folder: &Path) -> std::io::Result<()> {
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut asked = Vec::new();
    let mut piece = [0; 1024];
    while !asked.windows(4).any(|w| w == b"\r\n\r\n") {
        match stream.read(&mut piece)? {
            n if n > 0 && asked.len() < LONGEST => asked.extend(&piece[..n]),
            _ => return Ok(()),
        }
    }
    let (status, body) = match refusal(&String::from_utf8_lossy(&asked), port) {
        Some((status, text)) => (status, text.to_owned()),
        None => match standing(folder, RENEWED) {
            Ok(page) => ("200 OK", page),
            Err(e) => ("500 Internal Server Error", e.to_string()),
        },
    };
    let kind = if status.starts_with("200") { "text/html" } else { "text/plain" };
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}; charset=utf-8\r\nContent-Length: {}\r\n\
         Cache-Control: no-store\r\nX-Frame-Options: DENY\r\nX-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes())?;
    stream.write_all(body.as_bytes())
}

/// The refusal of a request, if it is not answered with the page. Accepting other host names would let a web page read
/// the run (DNS rebinding).
fn refusal(asked: &str, port: u16) -> Option<(&'static str, &'static str)> {
    let mut lines = asked.split("\r\n");
    let question = lines.next().unwrap_or_default();
    let host = lines.find_map(|l| l.split_once(':').filter(|(name, _)| name.eq_ignore_ascii_case("host")));
    let own = [format!("127.0.0.1:{port}"), format!("localhost:{port}")];
    if !host.is_some_and(|(_, host)| own.iter().any(|o| o == host.trim())) {
        return Some(("403 Forbidden", "only under http://127.0.0.1\n"));
    }
    match question.split(' ').collect::<Vec<_>>()[..] {
        ["GET", "/", _] => None,
        ["GET", ..] => Some(("404 Not Found", "only / is here\n")),
        _ => Some(("405 Method Not Allowed", "only GET\n")),
    }
}
