//! `rit certificates`: an authority of one's own, for people without one.

use crate::{cli::CertificatesOptions, failure::Failure, output};
use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa, KeyPair,
    KeyUsagePurpose,
};
use std::{
    fs::{DirBuilder, OpenOptions},
    io::Write as _,
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _},
    path::Path,
    process::ExitCode,
    time::{Duration, SystemTime},
};

const DAY: Duration = Duration::from_secs(24 * 60 * 60);

/// `rit certificates`.
pub fn run(options: &CertificatesOptions) -> Result<ExitCode, Failure> {
    let out = &options.out;
    let io = |error| Failure::input_message(format!("{}: {error}", out.display()));
    DirBuilder::new().recursive(true).mode(0o700).create(out).map_err(io)?;
    let out = out.canonicalize().map_err(io)?;

    let mut params = params("RIT authority", &[], options.days)?;
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let authority = CertifiedIssuer::self_signed(params, KeyPair::generate().map_err(Failure::runtime)?);
    let authority = authority.map_err(Failure::runtime)?;
    write(&out, "ca.pem", 0o644, &authority.pem())?;
    write(&out, "ca.key", 0o600, &authority.key().serialize_pem())?;
    for (name, hosts, usage) in [
        ("learner", &options.hosts[..], ExtendedKeyUsagePurpose::ServerAuth),
        ("client", &[], ExtendedKeyUsagePurpose::ClientAuth),
    ] {
        let mut params = self::params(&format!("RIT {name}"), hosts, options.days)?;
        params.extended_key_usages = vec![usage];
        let key = KeyPair::generate().map_err(Failure::runtime)?;
        let certificate = params.signed_by(&key, &authority).map_err(Failure::runtime)?;
        write(&out, &format!("{name}.pem"), 0o644, &certificate.pem())?;
        write(&out, &format!("{name}.key"), 0o600, &key.serialize_pem())?;
    }
    let out = out.display();
    output::print(&format!(
        "the learner, in its experiment or with --set:\n\
         [learner.tls]\n\
         certificate = \"{out}/learner.pem\"\n\
         key = \"{out}/learner.key\"\n\
         client_ca = \"{out}/ca.pem\"\n\
         \n\
         callers, with copies of these three files:\n\
         --tls-ca {out}/ca.pem --tls-certificate {out}/client.pem --tls-key {out}/client.key\n\
         \n\
         {out}/ca.key can make further certificates; keep it where others cannot get at it, or delete it.\n"
    ))?;
    Ok(ExitCode::SUCCESS)
}

fn params(name: &str, hosts: &[String], days: u32) -> Result<CertificateParams, Failure> {
    let refused = |error| Failure::input_message(format!("--host {}: {error}", hosts.join(" ")));
    let mut params = CertificateParams::new(hosts).map_err(refused)?;
    params.distinguished_name.push(DnType::CommonName, name);
    let now = SystemTime::now();
    // Clocks differ from host to host.
    params.not_before = (now - DAY).into();
    params.not_after = (now + days * DAY).into();
    Ok(params)
}

fn write(out: &Path, name: &str, mode: u32, text: &str) -> Result<(), Failure> {
    let path = out.join(name);
    let file = OpenOptions::new().write(true).create_new(true).mode(mode).open(&path);
    file.and_then(|mut file| file.write_all(text.as_bytes())).map_err(|error| {
        let remedy = "; nothing is written over, choose another --out";
        Failure::input_message(format!("{}: {error}{remedy}", path.display()))
    })
}
